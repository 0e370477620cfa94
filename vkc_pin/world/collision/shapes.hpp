// Moving and fixed shapes, and signed distances of pairs of them at many states at once, computed
// by coal.
//
// Shapes are rebuilt here from their dimensions, so that this module shares no C++ objects with
// coal's Python bindings; the distances are computed by the same libcoal.
#pragma once

#include <algorithm>
#include <atomic>
#include <limits>
#include <memory>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include <coal/distance.h>

#include "arrays.hpp"
#include "bodies.hpp"
#include "points.hpp"
#include "solids.hpp"

namespace {

using vkc_pin::PLACEMENT;
constexpr std::size_t COLUMNS = 10; // distance, normal, both witness points

coal::Transform3s transform(const double * numbers)
{
  return coal::Transform3s(
    Eigen::Map<const Eigen::Matrix3d>(numbers), Eigen::Map<const Eigen::Vector3d>(numbers + 9));
}

void copy_witness(const coal::DistanceResult & result, double * out)
{
  for (const coal::Vec3s * numbers : {&result.normal, &result.nearest_points[0], &result.nearest_points[1]})
    out = std::copy_n(numbers->data(), 3, out);
}

std::atomic<std::uint64_t> query_count{0}; // number of distances computed since the process began

class Shapes
{
public:
  // A pair at a state, with a lower bound of distance − margin; ties are broken by `rank`.
  struct Candidate
  {
    Index first, second, rank, index;
    double margin, bound;
  };

  struct Found
  {
    double shortfall, distance, witness[COLUMNS - 1], margin;
    Index index, rank;
    bool operator<(const Found & other) const
    {
      return std::tie(shortfall, distance, rank) < std::tie(other.shortfall, other.distance, other.rank);
    }
  };

  // Queries coal at one state at a time. Results are cleared between queries, since a warm start
  // would change the last digits.
  class Query
  {
  public:
    explicit Query(const Shapes & shapes)
    : shapes_(shapes), request_(shapes.request_), transforms_(shapes.moving_), transform_states_(shapes.moving_, 0)
    {
    }

    ~Query() { query_count += count_; }

    void set_placements(const double * placements)
    {
      if (placements != placements_)
        ++state_;
      placements_ = placements;
    }

    // Must be called when the numbers behind the current placements have changed.
    void invalidate() { ++state_; }

    // Distances to points of at least `bound` may be returned as `bound`.
    double compute_distance(Index first, Index second, double bound = std::numeric_limits<double>::infinity())
    {
      ++count_;
      result_.clear();
      const auto &one = get_transform(std::size_t(first)), &other = get_transform(std::size_t(second));
      return signed_distance(*shapes_.shapes_[first], one, *shapes_.shapes_[second], other, bound, request_, result_);
    }

    // Of candidates sorted by their bounds, selects at most `max_pairs` closer than `reach` with least
    // distance − margin; see distances.py.
    template<typename Candidates>
    void find_closest_pairs(
      std::size_t count,
      double reach,
      Index max_pairs,
      double rounding,
      std::vector<Found> & near,
      const Candidates & candidates)
    {
      for (std::size_t k = 0; k < count; ++k)
      {
        const Candidate candidate = candidates(k);
        const bool is_full = max_pairs >= 0 && Index(near.size()) >= max_pairs;
        // Then neither this candidate nor any later one can be among them.
        if (is_full && (max_pairs == 0 || candidate.bound > near[max_pairs - 1].shortfall + rounding))
          break;
        // Larger distances cannot enter the list.
        double bound = reach;
        if (is_full)
          bound = std::min(bound, near[max_pairs - 1].shortfall + candidate.margin + rounding);
        Found found;
        found.distance = compute_distance(candidate.first, candidate.second, bound);
        if (!(found.distance < bound))
          continue;
        found.shortfall = found.distance - candidate.margin;
        found.margin = candidate.margin;
        found.index = candidate.index;
        found.rank = candidate.rank;
        witness(found.witness);
        near.insert(std::upper_bound(near.begin(), near.end(), found), found);
      }
      if (max_pairs >= 0 && Index(near.size()) > max_pairs)
        near.resize(max_pairs);
    }

    void witness(double * out) const { copy_witness(result_, out); }

  private:
    const coal::Transform3s & get_transform(std::size_t shape)
    {
      if (shape >= shapes_.moving_)
        return shapes_.fixed_[shape - shapes_.moving_];
      if (transform_states_[shape] != state_)
      {
        transforms_[shape] = transform(placements_ + PLACEMENT * shape);
        transform_states_[shape] = state_;
      }
      return transforms_[shape];
    }

    const Shapes & shapes_;
    coal::DistanceRequest request_;
    coal::DistanceResult result_;
    std::vector<coal::Transform3s> transforms_;
    std::vector<std::size_t> transform_states_;
    const double * placements_ = nullptr;
    std::size_t state_ = 0, count_ = 0;
  };

  Shapes(const std::vector<Solid> & solids, const Numbers<2> & fixed, double tolerance)
  {
    if (fixed.shape(1) != PLACEMENT || fixed.shape(0) > solids.size())
      throw std::invalid_argument("placements of fixed shapes are of shape (S, 12), with at most as many shapes");
    for (const auto & solid : solids)
      shapes_.push_back(solid.geometry);
    moving_ = shapes_.size() - fixed.shape(0);
    for (std::size_t i = 0; i < fixed.shape(0); ++i)
      fixed_.push_back(transform(fixed.data() + PLACEMENT * i));
    request_ = make_request(tolerance);
  }

  Shapes move_fixed(const Indices<1> & which, const Numbers<2> & where) const
  {
    if (where.shape(0) != which.shape(0) || where.shape(1) != PLACEMENT)
      throw std::invalid_argument("placements are of shape (n, 12)");
    Shapes other(*this);
    for (std::size_t k = 0; k < which.shape(0); ++k)
    {
      if (which(k) < Index(moving_) || which(k) >= Index(shapes_.size()))
        throw std::out_of_range("not a fixed shape");
      other.fixed_[which(k) - moving_] = transform(where.data() + PLACEMENT * k);
    }
    return other;
  }

  Array<double> compute_distances(
    const Numbers<3> & moving, const Indices<1> & states, const Indices<2> & pairs, bool with_witnesses, std::size_t threads) const
  {
    const std::size_t count = pairs.shape(0), columns = with_witnesses ? COLUMNS : 1;
    check(moving, pairs);
    if (states.shape(0) != count)
      throw std::invalid_argument("as many states as pairs are needed");
    for (std::size_t i = 0; i < count; ++i)
      if (states(i) < 0 || states(i) >= Index(moving.shape(0)))
        throw std::out_of_range("no such state");
    std::vector<double> found(count * columns);
    const Index *state = states.data(), *pair = pairs.data();
    const double * where = moving.data();
    {
      nb::gil_scoped_release released;
      in_parts(count, threads, [&](std::size_t, std::size_t first, std::size_t last) {
        Query query(*this);
        for (std::size_t i = first; i < last; ++i)
        {
          query.set_placements(where + std::size_t(state[i]) * moving_ * PLACEMENT);
          found[i * columns] = query.compute_distance(pair[2 * i], pair[2 * i + 1]);
          if (with_witnesses)
            query.witness(found.data() + i * columns + 1);
        }
      });
    }
    if (with_witnesses)
      return handed_over(std::move(found), {count, COLUMNS});
    return handed_over(std::move(found), {count});
  }

  // For each state, the candidates from `edges[state]` to `edges[state + 1]` with least distance −
  // margin; see distances.py.
  std::tuple<Array<Index>, Array<double>> find_closest_pairs(
    const Numbers<3> & moving,
    const Indices<1> & edges,
    const Indices<2> & pairs,
    const Indices<1> & ranks,
    const Numbers<2> & limits,
    double reach,
    Index max_pairs,
    double rounding,
    std::size_t threads) const
  {
    const std::size_t states = moving.shape(0), count = pairs.shape(0);
    check(moving, pairs);
    if (edges.shape(0) != states + 1 || ranks.shape(0) != count || limits.shape(0) != count || limits.shape(1) != 2)
      throw std::invalid_argument("edges are of shape (W + 1,), ranks (n,), limits (n, 2)");
    for (std::size_t s = 0; s < states; ++s)
      if (edges(s) > edges(s + 1))
        throw std::invalid_argument("edges increase");
    if (edges(0) != 0 || edges(states) != Index(count))
      throw std::invalid_argument("edges begin with 0 and end with the number of pairs");
    std::vector<Index> chosen;
    std::vector<double> table;
    const Index *edge = edges.data(), *pair = pairs.data(), *rank = ranks.data();
    const double *limit = limits.data(), *where = moving.data();
    {
      nb::gil_scoped_release released;
      threads = std::max<std::size_t>(threads, 1);
      std::vector<std::vector<Found>> parts(threads);
      in_parts(states, threads, [&](std::size_t part, std::size_t first, std::size_t last) {
        Query query(*this);
        std::vector<Found> near;
        for (std::size_t s = first; s < last; ++s)
        {
          near.clear();
          query.set_placements(where + s * moving_ * PLACEMENT);
          const auto candidate = [&](std::size_t k) {
            const Index i = edge[s] + Index(k);
            return Candidate{pair[2 * i], pair[2 * i + 1], rank[i], i, limit[2 * i], limit[2 * i + 1]};
          };
          const std::size_t candidate_count = std::size_t(edge[s + 1] - edge[s]);
          query.find_closest_pairs(candidate_count, reach, max_pairs, rounding, near, candidate);
          parts[part].insert(parts[part].end(), near.begin(), near.end());
        }
      });
      for (const auto & part : parts)
        for (const auto & found : part)
        {
          chosen.push_back(found.index);
          table.push_back(found.distance);
          table.insert(table.end(), found.witness, found.witness + COLUMNS - 1);
        }
    }
    const std::size_t kept = chosen.size();
    return {handed_over(std::move(chosen), {kept}), handed_over(std::move(table), {kept, COLUMNS})};
  }

  std::size_t moving() const { return moving_; }

  std::size_t size() const { return shapes_.size(); }

private:
  void check(const Numbers<3> & moving, const Indices<2> & pairs) const
  {
    if (moving.shape(1) != moving_ || moving.shape(2) != PLACEMENT)
      throw std::invalid_argument("placements of moving shapes are of shape (W, M, 12)");
    if (pairs.shape(1) != 2)
      throw std::invalid_argument("pairs are of shape (n, 2)");
    const Index * shape = pairs.data();
    for (std::size_t i = 0; i < 2 * pairs.shape(0); ++i)
      if (shape[i] < 0 || shape[i] >= Index(shapes_.size()))
        throw std::out_of_range("no such shape");
  }

  std::vector<std::shared_ptr<coal::CollisionGeometry>> shapes_;
  std::vector<coal::Transform3s> fixed_;
  std::size_t moving_;
  coal::DistanceRequest request_;
};

// The distance of two shapes with normal and witness points; placements are of shape (12,).
Array<double> distance(
  const Solid & one, const Numbers<1> & where, const Solid & other, const Numbers<1> & there, double tolerance)
{
  if (where.shape(0) != PLACEMENT || there.shape(0) != PLACEMENT)
    throw std::invalid_argument("placements are of shape (12,)");
  std::vector<double> found(COLUMNS);
  coal::DistanceResult result;
  found[0] = signed_distance(
    *one.geometry, transform(where.data()), *other.geometry, transform(there.data()),
    std::numeric_limits<double>::infinity(), make_request(tolerance), result);
  copy_witness(result, found.data() + 1);
  ++query_count;
  return handed_over(std::move(found), {COLUMNS});
}

// Whether each point, of shape (n, 3), is closer than `reach` to a shape.
Array<std::uint8_t> find_near_points(
  const Solid & solid, const Numbers<1> & where, const Numbers<2> & points, double reach, double tolerance)
{
  if (where.shape(0) != PLACEMENT || points.shape(1) != 3)
    throw std::invalid_argument("a placement is of shape (12,), points are of shape (n, 3)");
  const coal::Transform3s placement = transform(where.data());
  const coal::DistanceRequest request = make_request(tolerance);
  const std::size_t count = points.shape(0);
  std::vector<std::uint8_t> near(count);
  for (std::size_t i = 0; i < count; ++i)
  {
    const coal::Vec3s local = placement.inverseTransform(coal::Vec3s(points(i, 0), points(i, 1), points(i, 2)));
    NearestPoint nearest(*solid.geometry, 0.0, reach, request);
    near[i] = nearest.is_near({{local[0], local[1], local[2]}});
  }
  return handed_over(std::move(near), {count});
}

} // namespace
