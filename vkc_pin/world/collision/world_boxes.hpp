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
  WorldBoxes(const Numbers<3> & lower, const Numbers<3> & upper, const Numbers<2> & fixed_lower, const Numbers<2> & fixed_upper)
  : lower_(lower), upper_(upper), fixed_lower_(fixed_lower), fixed_upper_(fixed_upper), moving_(lower.shape(1))
  {
    if (lower.shape(2) != 3 || upper.shape(0) != lower.shape(0) || upper.shape(1) != moving_ || upper.shape(2) != 3)
      throw std::invalid_argument("corners of moving shapes are of shape (W, M, 3)");
    if (fixed_lower.shape(1) != 3 || fixed_upper.shape(0) != fixed_lower.shape(0) || fixed_upper.shape(1) != 3)
      throw std::invalid_argument("corners of fixed shapes are of shape (S, 3)");
  }

  // Returns all (interval, pair), sorted by interval, whose distance may be less than `limit` [m]
  // during the interval. Shapes move by at most `moved`, (K, M + S) [m], during an interval. Pairs,
  // (P, 2), are skipped if neither shape moves in the phase of the interval according to `moves`,
  // (phases, M + S).
  std::pair<Array<Index>, Array<Index>> near(
    const Indices<2> & intervals, const Indices<1> & phases, const Flags & moves, const Indices<2> & pairs,
    const Numbers<2> & moved, double limit) const
  {
    check(intervals, phases, moves, pairs, moved);
    std::vector<Index> interval_indices, pair_indices;
    {
      nb::gil_scoped_release released;
      for (std::size_t begin = 0; begin < intervals.shape(0); begin += BATCH_SIZE)
      {
        const std::size_t end = std::min(begin + BATCH_SIZE, intervals.shape(0));
        find_in_batch(begin, end, intervals, phases, moves, pairs, moved, limit, interval_indices, pair_indices);
      }
    }
    const std::size_t found = interval_indices.size();
    return {handed_over(std::move(interval_indices), {found}), handed_over(std::move(pair_indices), {found})};
  }

private:
  // Intervals in a batch: pairs are excluded first by boxes around all states of the batch.
  static constexpr std::size_t BATCH_SIZE = 16;

  struct Box
  {
    double lower[3], upper[3];
  };

  void check(
    const Indices<2> & intervals, const Indices<1> & phases, const Flags & moves, const Indices<2> & pairs,
    const Numbers<2> & moved) const
  {
    const std::size_t count = intervals.shape(0), shapes = moving_ + fixed_lower_.shape(0);
    if (intervals.shape(1) != 2 || phases.shape(0) != count || moved.shape(0) != count)
      throw std::invalid_argument("an interval has two states, a phase, and the motion of each shape");
    if (moves.shape(1) != shapes || moved.shape(1) != shapes || pairs.shape(1) != 2)
      throw std::invalid_argument("moves has a column for each shape, and pairs have two shapes");
    const auto inside = [](const Index * first, const Index * last, std::size_t size) {
      return std::all_of(first, last, [size](Index i) { return i >= 0 && static_cast<std::size_t>(i) < size; });
    };
    if (
      !inside(intervals.data(), intervals.data() + 2 * count, lower_.shape(0)) ||
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
      found.lower[axis] = is_fixed ? fixed_lower_(shape - moving_, axis) : lower_(state, shape, axis);
      found.upper[axis] = is_fixed ? fixed_upper_(shape - moving_, axis) : upper_(state, shape, axis);
    }
    return found;
  }

  static double gap(const Box & a, const Box & b)
  {
    double sum = 0.0, largest = -std::numeric_limits<double>::infinity();
    for (std::size_t axis = 0; axis < 3; ++axis)
    {
      const double apart = std::max(b.lower[axis] - a.upper[axis], a.lower[axis] - b.upper[axis]);
      largest = std::max(largest, apart);
      sum += apart > 0.0 ? apart * apart : 0.0;
    }
    return largest > 0.0 ? std::sqrt(sum) : -std::numeric_limits<double>::infinity();
  }

  void find_in_batch(
    std::size_t begin, std::size_t end, const Indices<2> & intervals, const Indices<1> & phases, const Flags & moves,
    const Indices<2> & pairs, const Numbers<2> & moved, double limit, std::vector<Index> & interval_indices,
    std::vector<Index> & pair_indices) const
  {
    const std::size_t shapes = moves.shape(1);
    std::vector<Box> batch_boxes(shapes);
    std::vector<double> max_moved(shapes, 0.0);
    for (std::size_t shape = 0; shape < shapes; ++shape)
    {
      batch_boxes[shape] = box(intervals(begin, 0), shape);
      for (std::size_t k = begin; k < end; ++k)
      {
        max_moved[shape] = std::max(max_moved[shape], moved(k, shape));
        for (std::size_t side = 0; side < 2 && shape < moving_; ++side)
        {
          const Box one = box(intervals(k, side), shape);
          for (std::size_t axis = 0; axis < 3; ++axis)
          {
            batch_boxes[shape].lower[axis] = std::min(batch_boxes[shape].lower[axis], one.lower[axis]);
            batch_boxes[shape].upper[axis] = std::max(batch_boxes[shape].upper[axis], one.upper[axis]);
          }
        }
      }
    }
    std::vector<std::size_t> candidates;
    for (std::size_t p = 0; p < pairs.shape(0); ++p)
    {
      const std::size_t i = pairs(p, 0), j = pairs(p, 1);
      if (gap(batch_boxes[i], batch_boxes[j]) - 0.5 * (max_moved[i] + max_moved[j]) < limit)
        candidates.push_back(p);
    }
    for (std::size_t k = begin; k < end; ++k)
      for (const std::size_t p : candidates)
      {
        const std::size_t i = pairs(p, 0), j = pairs(p, 1);
        if (!moves(phases(k), i) && !moves(phases(k), j))
          continue;
        const double first = gap(box(intervals(k, 0), i), box(intervals(k, 0), j));
        double second = first;
        if (intervals(k, 1) != intervals(k, 0))
          second = gap(box(intervals(k, 1), i), box(intervals(k, 1), j));
        if ((first + second - (moved(k, i) + moved(k, j))) / 2 < limit)
        {
          interval_indices.push_back(static_cast<Index>(k));
          pair_indices.push_back(static_cast<Index>(p));
        }
      }
  }

  Numbers<3> lower_, upper_;
  Numbers<2> fixed_lower_, fixed_upper_;
  std::size_t moving_;
};
