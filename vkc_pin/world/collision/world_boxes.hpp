// Axis-aligned boxes around shapes at many states, and the pairs that may come close between two
// states.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "arrays.hpp"

using Flags = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

class WorldBoxes
{
public:
  // Corners of the boxes of moving shapes at all states, (W, M, 3), and of fixed shapes, (S, 3)
  // [m].
  WorldBoxes(const Numbers<3> & lower, const Numbers<3> & upper, const Numbers<2> & standing_lower, const Numbers<2> & standing_upper)
  : lower_(lower), upper_(upper), standing_lower_(standing_lower), standing_upper_(standing_upper), moving_(lower.shape(1))
  {
    if (lower.shape(2) != 3 || upper.shape(0) != lower.shape(0) || upper.shape(1) != moving_ || upper.shape(2) != 3)
      throw std::invalid_argument("corners of moving shapes are of shape (W, M, 3)");
    if (standing_lower.shape(1) != 3 || standing_upper.shape(0) != standing_lower.shape(0) || standing_upper.shape(1) != 3)
      throw std::invalid_argument("corners of fixed shapes are of shape (S, 3)");
  }

  // Returns all (interval, pair), sorted by interval, whose distance may be less than `limit` [m]
  // during the interval. Shapes move by at most `moved`, (K, M + S) [m], during an interval. Pairs,
  // (P, 2), are skipped if neither shape moves in the phase of the interval according to `moves`,
  // (phases, M + S).
  std::pair<Array<Index>, Array<Index>> near(
    const Indices<2> & stretches, const Indices<1> & phases, const Flags & moves, const Indices<2> & pairs,
    const Numbers<2> & moved, double limit) const
  {
    check(stretches, phases, moves, pairs, moved);
    std::vector<Index> at, which;
    {
      nb::gil_scoped_release released;
      for (std::size_t begin = 0; begin < stretches.shape(0); begin += TOGETHER)
        part(begin, std::min(begin + TOGETHER, stretches.shape(0)), stretches, phases, moves, pairs, moved, limit, at, which);
    }
    const std::size_t found = at.size();
    return {handed_over(std::move(at), {found}), handed_over(std::move(which), {found})};
  }

private:
  static constexpr std::size_t TOGETHER = 16; // intervals per batch; pairs are first culled by boxes around all states of a batch

  struct Box
  {
    double lower[3], upper[3];
  };

  void check(
    const Indices<2> & stretches, const Indices<1> & phases, const Flags & moves, const Indices<2> & pairs,
    const Numbers<2> & moved) const
  {
    const std::size_t count = stretches.shape(0), shapes = moving_ + standing_lower_.shape(0);
    if (stretches.shape(1) != 2 || phases.shape(0) != count || moved.shape(0) != count)
      throw std::invalid_argument("an interval has two states, a phase, and the motion of each shape");
    if (moves.shape(1) != shapes || moved.shape(1) != shapes || pairs.shape(1) != 2)
      throw std::invalid_argument("moves has a column for each shape, and pairs have two shapes");
    const auto inside = [](const Index * first, const Index * last, std::size_t most) {
      return std::all_of(first, last, [most](Index i) { return i >= 0 && static_cast<std::size_t>(i) < most; });
    };
    if (
      !inside(stretches.data(), stretches.data() + 2 * count, lower_.shape(0)) ||
      !inside(phases.data(), phases.data() + count, moves.shape(0)) ||
      !inside(pairs.data(), pairs.data() + 2 * pairs.shape(0), shapes))
      throw std::out_of_range("there is no such state, phase or shape");
  }

  Box box(std::size_t state, std::size_t shape) const
  {
    Box found;
    const bool is_fixed = shape >= moving_;
    for (std::size_t axis = 0; axis < 3; ++axis)
    {
      found.lower[axis] = is_fixed ? standing_lower_(shape - moving_, axis) : lower_(state, shape, axis);
      found.upper[axis] = is_fixed ? standing_upper_(shape - moving_, axis) : upper_(state, shape, axis);
    }
    return found;
  }

  static double gap(const Box & a, const Box & b)
  {
    double sum = 0.0, most = -std::numeric_limits<double>::infinity();
    for (std::size_t axis = 0; axis < 3; ++axis)
    {
      const double apart = std::max(b.lower[axis] - a.upper[axis], a.lower[axis] - b.upper[axis]);
      most = std::max(most, apart);
      sum += apart > 0.0 ? apart * apart : 0.0;
    }
    return most > 0.0 ? std::sqrt(sum) : -std::numeric_limits<double>::infinity();
  }

  void part(
    std::size_t begin, std::size_t end, const Indices<2> & stretches, const Indices<1> & phases, const Flags & moves,
    const Indices<2> & pairs, const Numbers<2> & moved, double limit, std::vector<Index> & at, std::vector<Index> & which) const
  {
    const std::size_t shapes = moves.shape(1);
    std::vector<Box> around(shapes);
    std::vector<double> farthest(shapes, 0.0);
    for (std::size_t shape = 0; shape < shapes; ++shape)
    {
      around[shape] = box(stretches(begin, 0), shape);
      for (std::size_t k = begin; k < end; ++k)
      {
        farthest[shape] = std::max(farthest[shape], moved(k, shape));
        for (std::size_t side = 0; side < 2 && shape < moving_; ++side)
        {
          const Box one = box(stretches(k, side), shape);
          for (std::size_t axis = 0; axis < 3; ++axis)
          {
            around[shape].lower[axis] = std::min(around[shape].lower[axis], one.lower[axis]);
            around[shape].upper[axis] = std::max(around[shape].upper[axis], one.upper[axis]);
          }
        }
      }
    }
    std::vector<std::size_t> some;
    for (std::size_t p = 0; p < pairs.shape(0); ++p)
    {
      const std::size_t i = pairs(p, 0), j = pairs(p, 1);
      if (gap(around[i], around[j]) - 0.5 * (farthest[i] + farthest[j]) < limit)
        some.push_back(p);
    }
    for (std::size_t k = begin; k < end; ++k)
      for (const std::size_t p : some)
      {
        const std::size_t i = pairs(p, 0), j = pairs(p, 1);
        if (!moves(phases(k), i) && !moves(phases(k), j))
          continue;
        const double first = gap(box(stretches(k, 0), i), box(stretches(k, 0), j));
        const double second = stretches(k, 1) == stretches(k, 0) ? first : gap(box(stretches(k, 1), i), box(stretches(k, 1), j));
        if ((first + second - (moved(k, i) + moved(k, j))) / 2 < limit)
        {
          at.push_back(static_cast<Index>(k));
          which.push_back(static_cast<Index>(p));
        }
      }
  }

  Numbers<3> lower_, upper_;
  Numbers<2> standing_lower_, standing_upper_;
  std::size_t moving_;
};
