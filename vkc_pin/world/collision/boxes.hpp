// Oriented bounding boxes of shapes on joints and of fixed shapes, and the pairs of them that may
// be close.
//
// There are tens of moving shapes, but possibly thousands of fixed ones. Therefore an axis-aligned
// box around all shapes of each joint is compared with those of all fixed shapes first. Only the
// remaining pairs are tested one by one. Why not coal's broadphase: docs/decisions/0010.
#pragma once

#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>

#include "arrays.hpp"
#include "vectors.hpp"

namespace {

class Boxes
{
public:
  // Joints (0: fixed), rotations and centres of the boxes on these, half extents; pairs, of which
  // at least the first moves.
  Boxes(
    const Indices<1> & joints,
    const Numbers<3> & rotations,
    const Numbers<2> & centers,
    const Numbers<2> & halves,
    const Indices<2> & pairs)
  : pairs_(std::make_shared<Pairs>())
  {
    const std::size_t count = joints.shape(0);
    if (
      rotations.shape(0) != count || rotations.shape(1) != 3 || rotations.shape(2) != 3 || centers.shape(0) != count
      || centers.shape(1) != 3 || halves.shape(0) != count || halves.shape(1) != 3 || pairs.shape(1) != 2)
      throw std::invalid_argument("boxes are of shapes (G,), (G, 3, 3), (G, 3), (G, 3), pairs of shape (P, 2)");
    Pairs & shared = *pairs_;
    while (shared.moving < count && joints(shared.moving) > 0)
      ++shared.moving;
    for (std::size_t g = 0; g < count; ++g)
    {
      if (joints(g) < 0 || (g >= shared.moving && joints(g) != 0))
        throw std::invalid_argument("boxes on joints come first");
      shared.joints.push_back(joints(g));
      shared.halves.push_back(vector_at(halves.data() + 3 * g));
      shared.radii.push_back(std::sqrt(square(shared.halves[g])));
      shared.max_joint = std::max(shared.max_joint, joints(g));
      rotations_.push_back(matrix_at(rotations.data() + 9 * g));
      centers_.push_back(vector_at(centers.data() + 3 * g));
    }
    shared.fixed = count - shared.moving;
    shared.number.assign(shared.moving * shared.fixed, -1);
    std::vector<bool> has_fixed_partner(shared.moving, false);
    for (std::size_t k = 0; k < pairs.shape(0); ++k)
    {
      const Index a = pairs(k, 0), b = pairs(k, 1);
      if (a < 0 || a >= Index(shared.moving) || b < 0 || b >= Index(count))
        throw std::out_of_range("of every pair the first moves, and both are among the boxes");
      shared.pairs.push_back({a, b});
      if (b < Index(shared.moving))
        shared.own.push_back({Index(k), a, b, shared.radii[a] + shared.radii[b]});
      else
      {
        shared.number[a * shared.fixed + (b - shared.moving)] = Index(k);
        has_fixed_partner[a] = true;
      }
    }
    shared.groups.resize(std::size_t(shared.max_joint) + 1);
    for (std::size_t a = 0; a < shared.moving; ++a)
      if (has_fixed_partner[a])
        shared.groups[shared.joints[a]].push_back(a);
    const auto empty = [](const auto & group) { return group.empty(); };
    shared.groups.erase(std::remove_if(shared.groups.begin(), shared.groups.end(), empty), shared.groups.end());
    update_corners();
  }

  // Returns a copy with some fixed boxes at other placements.
  Boxes move_fixed(const Indices<1> & which, const Numbers<3> & rotations, const Numbers<2> & centers) const
  {
    if (
      rotations.shape(0) != which.shape(0) || rotations.shape(1) != 3 || rotations.shape(2) != 3
      || centers.shape(0) != which.shape(0) || centers.shape(1) != 3)
      throw std::invalid_argument("placements are of shapes (n, 3, 3) and (n, 3)");
    Boxes other(*this);
    for (std::size_t k = 0; k < which.shape(0); ++k)
    {
      if (which(k) < Index(pairs_->moving) || which(k) >= Index(rotations_.size()))
        throw std::out_of_range("not a fixed shape");
      other.rotations_[which(k)] = matrix_at(rotations.data() + 9 * k);
      other.centers_[which(k)] = vector_at(centers.data() + 3 * k);
    }
    other.update_corners();
    return other;
  }

  struct Found { Index state, pair; double gap; };

  const std::vector<std::array<Index, 2>> & pairs() const { return pairs_->pairs; }
  std::size_t size() const { return rotations_.size(); }
  std::size_t moving() const { return pairs_->moving; }
  Index max_joint() const { return pairs_->max_joint; }

private:
  struct Own // a pair of two moving boxes
  {
    Index pair, first, second;
    double radii;
  };

  // Data that do not depend on the placements of fixed boxes; shared between copies.
  struct Pairs
  {
    std::size_t moving = 0, fixed = 0;
    Index max_joint = 0;
    std::vector<std::array<Index, 2>> pairs;
    std::vector<Index> joints, number; // number: index of the pair of a moving and a fixed box, or -1
    std::vector<Vector> halves;
    std::vector<double> radii;
    std::vector<Own> own;
    std::vector<std::vector<std::size_t>> groups; // moving boxes with fixed partners, by joint
  };

public:
  // Evaluates one configuration at a time.
  class Query
  {
  public:
    Query(const Boxes & boxes, double reach)
    : boxes_(boxes), pairs_(*boxes.pairs_), reach_(reach), rotations_(pairs_.moving), centers_(pairs_.moving),
      lower_(pairs_.groups.size()), upper_(pairs_.groups.size())
    {
    }

    // Appends the pairs closer than `reach` at the placements of the joints, sorted by pair.
    void find_close_pairs(
      std::size_t state,
      const double * rotations,
      const double * translations,
      bool include_fixed,
      std::vector<Found> & out)
    {
      for (std::size_t m = 0; m < pairs_.moving; ++m)
      {
        const std::size_t joint = std::size_t(pairs_.joints[m]);
        const Matrix turn = matrix_at(rotations + 9 * joint);
        rotations_[m] = product(turn, boxes_.rotations_[m]);
        centers_[m] = product(turn, boxes_.centers_[m]);
        for (int i = 0; i < 3; ++i)
          centers_[m].x[i] += translations[3 * joint + i];
      }
      const std::size_t begin = out.size();
      const auto keep = [&](Index pair, double gap) {
        if (gap < reach_)
          out.push_back({Index(state), pair, gap});
      };
      for (const auto & own : pairs_.own)
        if (square(difference(centers_[own.first], centers_[own.second])) < (own.radii + reach_) * (own.radii + reach_))
          keep(own.pair, gap(own.first, own.second, rotations_[own.second], centers_[own.second]));
      if (include_fixed)
        find_fixed(keep);
      std::sort(out.begin() + begin, out.end(), [](const Found & a, const Found & b) { return a.pair < b.pair; });
    }

  private:
    template<typename Keep>
    void find_fixed(const Keep & keep)
    {
      constexpr double far = std::numeric_limits<double>::infinity();
      Vector all_lower{{far, far, far}}, all_upper{{-far, -far, -far}};
      for (std::size_t g = 0; g < pairs_.groups.size(); ++g)
      {
        Vector low{{far, far, far}}, high{{-far, -far, -far}};
        for (const std::size_t a : pairs_.groups[g])
        {
          const Vector extent = product(magnitudes(rotations_[a]), pairs_.halves[a]);
          for (int i = 0; i < 3; ++i)
          {
            low.x[i] = std::min(low.x[i], centers_[a].x[i] - extent.x[i]);
            high.x[i] = std::max(high.x[i], centers_[a].x[i] + extent.x[i]);
          }
        }
        for (int i = 0; i < 3; ++i)
        {
          lower_[g].x[i] = low.x[i] - reach_;
          upper_[g].x[i] = high.x[i] + reach_;
          all_lower.x[i] = std::min(all_lower.x[i], lower_[g].x[i]);
          all_upper.x[i] = std::max(all_upper.x[i], upper_[g].x[i]);
        }
      }
      for (std::size_t s = 0; s < pairs_.fixed; ++s)
      {
        const Vector &low = boxes_.fixed_lower_[s], &high = boxes_.fixed_upper_[s];
        if (!overlap(all_lower, all_upper, low, high))
          continue;
        for (std::size_t g = 0; g < pairs_.groups.size(); ++g)
          if (overlap(lower_[g], upper_[g], low, high))
            for (const std::size_t a : pairs_.groups[g])
              check_pair(a, s, keep);
      }
    }

    template<typename Keep>
    void check_pair(std::size_t a, std::size_t s, const Keep & keep) const
    {
      const Index pair = pairs_.number[a * pairs_.fixed + s];
      if (pair < 0)
        return;
      const std::size_t b = pairs_.moving + s;
      const Matrix & turn = boxes_.rotations_[b];
      Vector outside = product_transposed(turn, difference(centers_[a], boxes_.centers_[b]));
      for (int i = 0; i < 3; ++i)
        outside.x[i] = std::max(std::abs(outside.x[i]) - pairs_.halves[b].x[i], 0.0);
      const double ball = pairs_.radii[a] + reach_;
      if (square(outside) < ball * ball)
        keep(pair, gap(a, b, turn, boxes_.centers_[b]));
    }

    static bool overlap(const Vector & lower, const Vector & upper, const Vector & low, const Vector & high)
    {
      for (int i = 0; i < 3; ++i)
        if (!(lower.x[i] < high.x[i] && upper.x[i] > low.x[i]))
          return false;
      return true;
    }

    // Largest separation along the face normals of either box. It is a lower bound of the signed
    // distance even if negative, since a translation by that amount separates the boxes.
    double gap(std::size_t a, std::size_t b, const Matrix & turn_b, const Vector & center_b) const
    {
      const Vector & half_a = pairs_.halves[a];
      const Vector & half_b = pairs_.halves[b];
      // Offset of the centres, and half extents of the other box, along the axes of each box.
      const Vector offset = difference(center_b, centers_[a]);
      const Matrix mixed = magnitudes(product_transposed(rotations_[a], turn_b));
      const Vector along_a = product_transposed(rotations_[a], offset);
      const Vector along_b = product_transposed(turn_b, offset);
      const Vector reach_b = product(mixed, half_b);
      const Vector reach_a = product_transposed(mixed, half_a);
      double largest = -std::numeric_limits<double>::infinity();
      for (int i = 0; i < 3; ++i)
      {
        largest = std::max(largest, std::abs(along_a.x[i]) - half_a.x[i] - reach_b.x[i]);
        largest = std::max(largest, std::abs(along_b.x[i]) - half_b.x[i] - reach_a.x[i]);
      }
      return largest;
    }

    const Boxes & boxes_;
    const Pairs & pairs_;
    double reach_;
    std::vector<Matrix> rotations_;
    std::vector<Vector> centers_, lower_, upper_;
  };

private:
  // Computes the corners of axis-aligned boxes around fixed shapes.
  void update_corners()
  {
    fixed_lower_.assign(pairs_->fixed, Vector());
    fixed_upper_.assign(pairs_->fixed, Vector());
    for (std::size_t s = 0; s < pairs_->fixed; ++s)
    {
      const std::size_t g = pairs_->moving + s;
      const Vector extent = product(magnitudes(rotations_[g]), pairs_->halves[g]);
      for (int i = 0; i < 3; ++i)
      {
        fixed_lower_[s].x[i] = centers_[g].x[i] - extent.x[i];
        fixed_upper_[s].x[i] = centers_[g].x[i] + extent.x[i];
      }
    }
  }

  std::shared_ptr<Pairs> pairs_;
  std::vector<Matrix> rotations_;  // in the frame of the joint, or in the world frame for fixed boxes
  std::vector<Vector> centers_;    // in the same frames
  std::vector<Vector> fixed_lower_, fixed_upper_; // corners of axis-aligned boxes around fixed shapes
};

} // namespace
