// Pairs of shapes with least distance − margin at given configurations: kinematics, bounding
// volumes and distances.
#pragma once

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "bodies.hpp"
#include "boxes.hpp"
#include "margins.hpp"
#include "shapes.hpp"

namespace {

using vkc_pin::Bodies;

// The shapes, moved by bodies or fixed, with their bounding boxes, the pairs to check, and the
// margins of these.
struct Parts
{
  const Bodies & bodies;
  const Boxes & boxes;
  const Shapes & shapes;
  const Margins & margins;
};

// Configurations q, and the coordinates z that select margins.
struct States
{
  const double *q, *z;
  std::size_t count, coordinates, columns;

  States(const Parts & parts, const Numbers<2> & q, const Numbers<2> & z)
  : States(parts, q.data(), z.data(), q.shape(0), q.shape(1), z.shape(1))
  {
    if (z.shape(0) != count)
      throw std::invalid_argument("configurations are of shape (W, nq), coordinates of shape (W, n)");
  }

  States(
    const Parts & parts, const double * q, const double * z, std::size_t count, std::size_t coordinates, std::size_t columns)
  : q(q), z(z), count(count), coordinates(coordinates), columns(columns)
  {
    if (coordinates != parts.bodies.coordinates() || columns < parts.margins.coordinates())
      throw std::invalid_argument("configurations are of shape (W, nq), coordinates of shape (W, n)");
    if (
      parts.boxes.size() != parts.shapes.size() || parts.boxes.moving() != parts.shapes.moving()
      || parts.bodies.shapes() != parts.shapes.moving() || parts.margins.size() != parts.boxes.pairs().size())
      throw std::invalid_argument("bodies, boxes, shapes and margins do not belong together");
    if (parts.boxes.max_joint() >= Index(parts.bodies.joints()))
      throw std::out_of_range("no such joint");
  }
};

// Evaluates one configuration at a time.
class ClearanceQuery
{
public:
  ClearanceQuery(const Parts & parts, const States & states, double reach, double rounding)
  : parts_(parts), states_(states), kinematics_(parts.bodies), box_query_(parts.boxes, reach),
    distance_query_(parts.shapes), reach_(reach), rounding_(rounding)
  {
  }

  // Returns at most `max_pairs` pairs closer than `reach` at a configuration, sorted by distance −
  // margin.
  const std::vector<Shapes::Found> & find_closest_pairs(
    std::size_t state, Index waypoint, bool include_fixed, Index max_pairs)
  {
    prepare(state, waypoint, include_fixed);
    closest_.clear();
    const auto candidate = [this](std::size_t k) { return candidates_[k]; };
    distance_query_.find_closest_pairs(candidates_.size(), reach_, max_pairs, rounding_, closest_, candidate);
    return closest_;
  }

  // Returns whether any pair closer than `reach` violates its margin by more than `allowed`.
  bool has_violation(std::size_t state, Index waypoint, double allowed)
  {
    prepare(state, waypoint, true);
    for (const auto & candidate : candidates_)
    {
      if (candidate.bound > rounding_ - allowed)
        return false; // since candidates are sorted by their bounds
      const double bound = std::min(reach_, candidate.margin - allowed);
      const double distance = distance_query_.compute_distance(candidate.first, candidate.second, bound);
      if (distance < bound && candidate.margin - distance > allowed)
        return true;
    }
    return false;
  }

private:
  // Finds candidate pairs by their bounding boxes, sorted by their lower bounds of distance −
  // margin.
  void prepare(std::size_t state, Index waypoint, bool include_fixed)
  {
    kinematics_.compute(states_.q + state * states_.coordinates);
    found_.clear();
    box_query_.find_close_pairs(state, kinematics_.rotations(), kinematics_.translations(), include_fixed, found_);
    candidates_.clear();
    for (const auto & found : found_)
    {
      const double margin = parts_.margins.compute_margin(found.pair, waypoint, states_.z + state * states_.columns);
      if (margin == -std::numeric_limits<double>::infinity())
        continue;
      const auto & pair = parts_.boxes.pairs()[std::size_t(found.pair)];
      candidates_.push_back({pair[0], pair[1], found.pair, found.pair, margin, found.gap - margin});
    }
    std::sort(candidates_.begin(), candidates_.end(), [](const auto & a, const auto & b) {
      return std::tie(a.bound, a.rank) < std::tie(b.bound, b.rank);
    });
    distance_query_.set_placements(kinematics_.shapes());
    distance_query_.invalidate();
  }

  const Parts & parts_;
  const States & states_;
  Bodies::Kinematics kinematics_;
  Boxes::Query box_query_;
  Shapes::Query distance_query_;
  double reach_, rounding_;
  std::vector<Boxes::Found> found_;
  std::vector<Shapes::Candidate> candidates_;
  std::vector<Shapes::Found> closest_;
};

// Placements of the shapes of bodies, (W, n, 12).
Array<double> compute_placements(const Bodies & bodies, const Numbers<2> & q)
{
  if (q.shape(1) != bodies.coordinates())
    throw std::invalid_argument("configurations are of shape (W, nq)");
  const std::size_t states = q.shape(0), shapes = bodies.shapes(), size = PLACEMENT * shapes;
  std::vector<double> found(states * size);
  {
    nb::gil_scoped_release released;
    Bodies::Kinematics kinematics(bodies);
    for (std::size_t s = 0; s < states; ++s)
    {
      kinematics.compute(q.data() + s * q.shape(1));
      std::copy_n(kinematics.shapes(), size, found.begin() + std::ptrdiff_t(s * size));
    }
  }
  return handed_over(std::move(found), {states, shapes, PLACEMENT});
}

Array<double> compute_jacobians(const Bodies & bodies, const Numbers<2> & q)
{
  if (q.shape(1) != bodies.coordinates())
    throw std::invalid_argument("configurations are of shape (W, nq)");
  const std::size_t states = q.shape(0), shapes = bodies.shapes(), size = 6 * bodies.velocities() * shapes;
  std::vector<double> found(states * size);
  {
    nb::gil_scoped_release released;
    Bodies::Kinematics kinematics(bodies);
    for (std::size_t s = 0; s < states; ++s)
      kinematics.compute_jacobians(q.data() + s * q.shape(1), found.data() + s * size);
  }
  return handed_over(std::move(found), {states, shapes, 6, bodies.velocities()});
}

Array<double> compute_inverse_dynamics(
  const Bodies & bodies, const Numbers<2> & q, const Numbers<2> & v, const Numbers<2> & a)
{
  const std::size_t states = q.shape(0), velocities = bodies.velocities();
  if (q.shape(1) != bodies.coordinates())
    throw std::invalid_argument("configurations are of shape (W, nq)");
  for (const auto * rates : {&v, &a})
    if (rates->shape(0) != states || rates->shape(1) != velocities)
      throw std::invalid_argument("velocities and accelerations are of shape (W, nv)");
  std::vector<double> found(states * velocities);
  {
    nb::gil_scoped_release released;
    Bodies::Kinematics kinematics(bodies);
    for (std::size_t s = 0; s < states; ++s)
      kinematics.compute_inverse_dynamics(
        q.data() + s * q.shape(1), v.data() + s * velocities, a.data() + s * velocities, found.data() + s * velocities);
  }
  return handed_over(std::move(found), {states, velocities});
}

// State, pair, distance, margin, normal and witness points of the pairs with least distance −
// margin; see distances.py.
std::tuple<Array<Index>, Array<Index>, Array<double>, Array<double>, Array<double>, Array<double>, Array<double>> find_closest_pairs(
  const Bodies & bodies,
  const Boxes & boxes,
  const Shapes & shapes,
  const Margins & margins,
  const Numbers<2> & q,
  const Numbers<2> & z,
  const Indices<1> & waypoints,
  double reach,
  Index max_pairs,
  bool include_fixed,
  double rounding,
  std::size_t threads)
{
  const Parts parts{bodies, boxes, shapes, margins};
  const States states(parts, q, z);
  if (waypoints.shape(0) != states.count)
    throw std::invalid_argument("as many waypoints as configurations are needed");
  std::vector<Index> where, which;
  std::vector<double> distance, margin, normal, first, second;
  const Index * waypoint = waypoints.data();
  {
    nb::gil_scoped_release released;
    threads = std::max<std::size_t>(threads, 1);
    std::vector<std::vector<std::pair<std::size_t, Shapes::Found>>> found(threads);
    in_parts(states.count, threads, [&](std::size_t part, std::size_t begin, std::size_t end) {
      ClearanceQuery query(parts, states, reach, rounding);
      for (std::size_t s = begin; s < end; ++s)
        for (const auto & near : query.find_closest_pairs(s, waypoint[s], include_fixed, max_pairs))
          found[part].emplace_back(s, near);
    });
    for (const auto & part : found)
      for (const auto & [state, near] : part)
      {
        where.push_back(Index(state));
        which.push_back(near.index);
        distance.push_back(near.distance);
        margin.push_back(near.margin);
        normal.insert(normal.end(), near.witness, near.witness + 3);
        first.insert(first.end(), near.witness + 3, near.witness + 6);
        second.insert(second.end(), near.witness + 6, near.witness + 9);
      }
  }
  const std::size_t count = where.size();
  return {handed_over(std::move(where), {count}),       handed_over(std::move(which), {count}),
          handed_over(std::move(distance), {count}),    handed_over(std::move(margin), {count}),
          handed_over(std::move(normal), {count, 3}),   handed_over(std::move(first), {count, 3}),
          handed_over(std::move(second), {count, 3})};
}

// For each run of configurations, from one of `edges` to the next, the number of those before the
// first one in which a pair closer than `reach` violates its margin by more than `allowed`.
Array<Index> count_free(
  const Bodies & bodies,
  const Boxes & boxes,
  const Shapes & shapes,
  const Margins & margins,
  const Numbers<2> & q,
  const Numbers<2> & z,
  const Indices<1> & edges,
  Index waypoint,
  double reach,
  double allowed,
  double rounding)
{
  const Parts parts{bodies, boxes, shapes, margins};
  const States states(parts, q, z);
  const Index * edge = edges.data();
  if (!edges.shape(0) || edge[0] < 0 || edge[edges.shape(0) - 1] > Index(states.count))
    throw std::out_of_range("runs are within the configurations");
  std::vector<Index> free(edges.shape(0) - 1);
  {
    nb::gil_scoped_release released;
    ClearanceQuery query(parts, states, reach, rounding);
    for (std::size_t run = 0; run < free.size(); ++run)
    {
      Index state = edge[run];
      while (state < edge[run + 1] && !query.has_violation(std::size_t(state), waypoint, allowed))
        ++state;
      free[run] = state - edge[run];
    }
  }
  const std::size_t count = free.size();
  return handed_over(std::move(free), {count});
}

} // namespace
