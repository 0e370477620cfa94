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
    Pairs & known = *pairs_;
    while (known.moving < count && joints(known.moving) > 0)
      ++known.moving;
    for (std::size_t g = 0; g < count; ++g)
    {
      if (joints(g) < 0 || (g >= known.moving && joints(g) != 0))
        throw std::invalid_argument("boxes on joints come first");
      known.joints.push_back(joints(g));
      known.halves.push_back(vector_at(halves.data() + 3 * g));
      known.radii.push_back(std::sqrt(square(known.halves[g])));
      known.most_joints = std::max(known.most_joints, joints(g));
      turns_.push_back(matrix_at(rotations.data() + 9 * g));
      centers_.push_back(vector_at(centers.data() + 3 * g));
    }
    known.standing = count - known.moving;
    known.number.assign(known.moving * known.standing, -1);
    std::vector<bool> meets(known.moving, false);
    for (std::size_t k = 0; k < pairs.shape(0); ++k)
    {
      const Index a = pairs(k, 0), b = pairs(k, 1);
      if (a < 0 || a >= Index(known.moving) || b < 0 || b >= Index(count))
        throw std::out_of_range("of every pair the first moves, and both are among the boxes");
      known.pairs.push_back({a, b});
      if (b < Index(known.moving))
        known.own.push_back({Index(k), a, b, known.radii[a] + known.radii[b]});
      else
      {
        known.number[a * known.standing + (b - known.moving)] = Index(k);
        meets[a] = true;
      }
    }
    known.groups.resize(std::size_t(known.most_joints) + 1);
    for (std::size_t a = 0; a < known.moving; ++a)
      if (meets[a])
        known.groups[known.joints[a]].push_back(a);
    const auto empty = [](const auto & group) { return group.empty(); };
    known.groups.erase(std::remove_if(known.groups.begin(), known.groups.end(), empty), known.groups.end());
    corners();
  }

  // Returns a copy with some fixed boxes at other placements.
  Boxes placed(const Indices<1> & which, const Numbers<3> & rotations, const Numbers<2> & centers) const
  {
    if (
      rotations.shape(0) != which.shape(0) || rotations.shape(1) != 3 || rotations.shape(2) != 3
      || centers.shape(0) != which.shape(0) || centers.shape(1) != 3)
      throw std::invalid_argument("placements are of shapes (n, 3, 3) and (n, 3)");
    Boxes other(*this);
    for (std::size_t k = 0; k < which.shape(0); ++k)
    {
      if (which(k) < Index(pairs_->moving) || which(k) >= Index(turns_.size()))
        throw std::out_of_range("not a fixed shape");
      other.turns_[which(k)] = matrix_at(rotations.data() + 9 * k);
      other.centers_[which(k)] = vector_at(centers.data() + 3 * k);
    }
    other.corners();
    return other;
  }

  struct Found { Index state, pair; double gap; };

  const std::vector<std::array<Index, 2>> & pairs() const { return pairs_->pairs; }
  std::size_t size() const { return turns_.size(); }
  std::size_t moving() const { return pairs_->moving; }
  Index most_joints() const { return pairs_->most_joints; }

private:
  struct Own // a pair of two moving boxes
  {
    Index pair, first, second;
    double radii;
  };

  // Data that do not depend on the placements of fixed boxes; shared between copies.
  struct Pairs
  {
    std::size_t moving = 0, standing = 0;
    Index most_joints = 0;
    std::vector<std::array<Index, 2>> pairs;
    std::vector<Index> joints, number; // number: index of the pair of a moving and a fixed box, or -1
    std::vector<Vector> halves;
    std::vector<double> radii;
    std::vector<Own> own;
    std::vector<std::vector<std::size_t>> groups; // moving boxes with fixed partners, by joint
  };

public:
  // Evaluates one configuration at a time.
  class Looking
  {
  public:
    Looking(const Boxes & boxes, double reach)
    : boxes_(boxes), pairs_(*boxes.pairs_), reach_(reach), turns_(pairs_.moving), centers_(pairs_.moving),
      lower_(pairs_.groups.size()), upper_(pairs_.groups.size())
    {
    }

    void at(std::size_t state, const double * rotations, const double * translations, bool standing, std::vector<Found> & out)
    {
      for (std::size_t m = 0; m < pairs_.moving; ++m)
      {
        const std::size_t joint = std::size_t(pairs_.joints[m]);
        const Matrix turn = matrix_at(rotations + 9 * joint);
        turns_[m] = product(turn, boxes_.turns_[m]);
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
          keep(own.pair, gap(own.first, own.second, turns_[own.second], centers_[own.second]));
      if (standing)
        with_standing(keep);
      std::sort(out.begin() + begin, out.end(), [](const Found & a, const Found & b) { return a.pair < b.pair; });
    }

  private:
    template<typename Keep>
    void with_standing(const Keep & keep)
    {
      constexpr double far = std::numeric_limits<double>::infinity();
      Vector least{{far, far, far}}, most{{-far, -far, -far}};
      for (std::size_t g = 0; g < pairs_.groups.size(); ++g)
      {
        Vector low{{far, far, far}}, high{{-far, -far, -far}};
        for (const std::size_t a : pairs_.groups[g])
        {
          const Vector extent = product(magnitudes(turns_[a]), pairs_.halves[a]);
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
          least.x[i] = std::min(least.x[i], lower_[g].x[i]);
          most.x[i] = std::max(most.x[i], upper_[g].x[i]);
        }
      }
      for (std::size_t s = 0; s < pairs_.standing; ++s)
      {
        const Vector &low = boxes_.lows_[s], &high = boxes_.highs_[s];
        if (!overlap(least, most, low, high))
          continue;
        for (std::size_t g = 0; g < pairs_.groups.size(); ++g)
          if (overlap(lower_[g], upper_[g], low, high))
            for (const std::size_t a : pairs_.groups[g])
              look_at(a, s, keep);
      }
    }

    template<typename Keep>
    void look_at(std::size_t a, std::size_t s, const Keep & keep) const
    {
      const Index pair = pairs_.number[a * pairs_.standing + s];
      if (pair < 0)
        return;
      const std::size_t b = pairs_.moving + s;
      const Matrix & turn = boxes_.turns_[b];
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
      const Vector between = difference(center_b, centers_[a]), &half_a = pairs_.halves[a], &half_b = pairs_.halves[b];
      const Matrix mixed = magnitudes(product_transposed(turns_[a], turn_b));
      const Vector along_a = product_transposed(turns_[a], between), reach_b = product(mixed, half_b);
      const Vector along_b = product_transposed(turn_b, between), reach_a = product_transposed(mixed, half_a);
      double most = -std::numeric_limits<double>::infinity();
      for (int i = 0; i < 3; ++i)
      {
        most = std::max(most, std::abs(along_a.x[i]) - half_a.x[i] - reach_b.x[i]);
        most = std::max(most, std::abs(along_b.x[i]) - half_b.x[i] - reach_a.x[i]);
      }
      return most;
    }

    const Boxes & boxes_;
    const Pairs & pairs_;
    double reach_;
    std::vector<Matrix> turns_;
    std::vector<Vector> centers_, lower_, upper_;
  };

private:
  // Computes the corners of axis-aligned boxes around fixed shapes.
  void corners()
  {
    lows_ = highs_ = std::vector<Vector>(pairs_->standing);
    for (std::size_t s = 0; s < pairs_->standing; ++s)
    {
      const std::size_t g = pairs_->moving + s;
      const Vector extent = product(magnitudes(turns_[g]), pairs_->halves[g]);
      for (int i = 0; i < 3; ++i)
      {
        lows_[s].x[i] = centers_[g].x[i] - extent.x[i];
        highs_[s].x[i] = centers_[g].x[i] + extent.x[i];
      }
    }
  }

  std::shared_ptr<Pairs> pairs_;
  std::vector<Matrix> turns_;  // in the frame of the joint, or in the world frame for fixed boxes
  std::vector<Vector> centers_, lows_, highs_; // centres likewise; corners of axis-aligned boxes
};

} // namespace
