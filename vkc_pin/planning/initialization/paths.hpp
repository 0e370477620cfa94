// Paths of straight lines between configurations, and shortcuts on them.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "../../world/collision/straight.hpp"

using Row = std::vector<double>;
using Rows = std::vector<Row>;

// Weighted distances between configurations.
class Measure
{
public:
  explicit Measure(Row weights) : weights_(std::move(weights)) {}

  double square(const Row & a, const Row & b) const
  {
    double sum = 0.0;
    for (std::size_t k = 0; k < weights_.size(); ++k)
    {
      const double part = (b[k] - a[k]) * weights_[k];
      sum += part * part;
    }
    return sum;
  }

  // Returns the length of the path up to each of its configurations.
  Row passed(const Rows & path) const
  {
    Row found(path.size(), 0.0);
    for (std::size_t k = 1; k < path.size(); ++k)
      found[k] = found[k - 1] + std::sqrt(square(path[k - 1], path[k]));
    return found;
  }

private:
  Row weights_;
};

inline bool free_along(vkc_pin::StraightLines & lines, const Rows & path)
{
  for (std::size_t k = 1; k < path.size(); ++k)
    if (lines.free(path[k - 1].data(), path[k].data()) < 1.0)
      return false;
  return true;
}

inline Row between(const Row & a, const Row & b, double share)
{
  Row found(a.size());
  for (std::size_t k = 0; k < a.size(); ++k)
    found[k] = share >= 1.0 ? b[k] : a[k] + share * (b[k] - a[k]);
  return found;
}

// Returns the piece of a path at the length `at`; the last one at its end.
inline std::size_t piece(const Row & passed, double at)
{
  const auto after = std::upper_bound(passed.begin(), passed.end(), at);
  return std::min(std::size_t(std::max<std::ptrdiff_t>(after - passed.begin() - 1, 0)), passed.size() - 2);
}

inline Row place(const Rows & path, const Row & passed, double at)
{
  const std::size_t k = piece(passed, at);
  const double length = passed[k + 1] - passed[k];
  return between(path[k], path[k + 1], length > 0.0 ? std::clamp((at - passed[k]) / length, 0.0, 1.0) : 1.0);
}

// Replaces a part of a path by a straight line if that is collision-free.
inline void shorten(vkc_pin::StraightLines & lines, const Measure & measure, Rows & path, double from, double to)
{
  const Row passed = measure.passed(path);
  const double s = std::min(from, to) * passed.back(), t = std::max(from, to) * passed.back();
  const std::size_t i = piece(passed, s), j = piece(passed, t);
  if (i == j)
    return;
  const Row a = place(path, passed, s), b = place(path, passed, t);
  if (lines.free(a.data(), b.data()) < 1.0)
    return;
  Rows changed(path.begin(), path.begin() + std::ptrdiff_t(i) + 1);
  changed.push_back(a);
  changed.push_back(b);
  changed.insert(changed.end(), path.begin() + std::ptrdiff_t(j) + 1, path.end());
  path = std::move(changed);
}

// Moves some coordinates evenly along a part of a path (partial shortcut) if that saves the given share of its length and is
// collision-free. The new path has other configurations.
inline void make_even(
  vkc_pin::StraightLines & lines,
  const Measure & measure,
  Rows & path,
  const std::vector<std::size_t> & columns,
  double from,
  double to,
  double worth)
{
  if (path.size() < 2)
    return;
  const Row passed = measure.passed(path);
  const double s = std::min(from, to) * passed.back(), t = std::max(from, to) * passed.back();
  Rows part{place(path, passed, s)};
  Row at{s};
  for (std::size_t k = 0; k < path.size(); ++k)
    if (s < passed[k] && passed[k] < t)
    {
      part.push_back(path[k]);
      at.push_back(passed[k]);
    }
  part.push_back(place(path, passed, t));
  for (std::size_t k = 1; k + 1 < part.size(); ++k)
    for (const std::size_t column : columns)
      part[k][column] = part[0][column] + (at[k] - s) / std::max(t - s, 1e-12) * (part.back()[column] - part[0][column]);
  Rows changed;
  const auto add = [&](const Row & row) {
    if (changed.empty() || measure.square(changed.back(), row) > 0.0)
      changed.push_back(row);
  };
  for (std::size_t k = 0; k < path.size() && passed[k] <= s; ++k)
    add(path[k]);
  for (const Row & row : part)
    add(row);
  for (std::size_t k = 0; k < path.size(); ++k)
    if (passed[k] >= t)
      add(path[k]);
  if (measure.passed(changed).back() < (1.0 - worth) * passed.back() && free_along(lines, part))
    path = std::move(changed);
}
