// Checks straight lines between configurations of a robot in fixed steps, with all other
// coordinates constant.
#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>
#include <vector>

#include "clearances.hpp"
#include "straight.hpp"

namespace {

// Maps minimal coordinates z to Pinocchio's q: index pairs (in q, in z).
struct Places
{
  std::vector<std::pair<std::size_t, std::size_t>> plain, angles, quaternions; // angles map to cos and sin, quaternions have four entries

  void configuration(const double * z, double * q) const
  {
    for (const auto & [i, j] : plain)
      q[i] = z[j];
    for (const auto & [i, j] : angles)
    {
      q[i] = std::cos(z[j]);
      q[i + 1] = std::sin(z[j]);
    }
    for (const auto & [i, j] : quaternions)
    {
      const double length = std::sqrt(z[j] * z[j] + z[j + 1] * z[j + 1] + z[j + 2] * z[j + 2] + z[j + 3] * z[j + 3]);
      for (std::size_t k = 0; k < 4; ++k)
        q[i + k] = z[j + k] / length;
    }
  }
};

// Not thread-safe.
class Lines : public vkc_pin::StraightLines
{
public:
  // The first coordinates of `z`, one per entry of `weights`, vary. Between successive checks no
  // coordinate changes by more than `step` divided by its weight. See clearances.py for the other
  // arguments.
  Lines(
    const Bodies & bodies,
    const Boxes & boxes,
    const Shapes & shapes,
    const Margins & margins,
    const Indices<2> & plain,
    const Indices<2> & angles,
    const Indices<2> & quaternions,
    const Numbers<1> & z,
    const Numbers<1> & weights,
    double step,
    Index waypoint,
    double reach,
    double allowed,
    double rounding)
  : parts_{bodies, boxes, shapes, margins}, z_(z.data(), z.data() + z.shape(0)), q_(bodies.coordinates()),
    weights_(weights.data(), weights.data() + weights.shape(0)),
    places_{pairs(plain, 1, 1), pairs(angles, 2, 1), pairs(quaternions, 4, 4)},
    states_(parts_, q_.data(), z_.data(), 1, q_.size(), z_.size()), clearing_(parts_, states_, reach, rounding), step_(step),
    waypoint_(waypoint), allowed_(allowed)
  {
    if (weights_.size() > z_.size() || !(step > 0.0))
      throw std::invalid_argument("more coordinates move than there are, or no step");
  }
  Lines(const Lines &) = delete;

  std::size_t size() const override { return weights_.size(); }

  double free(const double * from, const double * to) override
  {
    double most = 0.0;
    for (std::size_t k = 0; k < size(); ++k)
      most = std::max(most, std::abs((to[k] - from[k]) * weights_[k]));
    const double count = std::max(1.0, std::ceil(most / step_));
    for (double at = 1.0; at <= count; ++at)
    {
      for (std::size_t k = 0; k < size(); ++k)
        z_[k] = from[k] + at / count * (to[k] - from[k]);
      places_.configuration(z_.data(), q_.data());
      ++looked_;
      if (clearing_.blocked(0, waypoint_, allowed_))
        return (at - 1.0) / count;
    }
    return 1.0;
  }

  // Returns the number of configurations checked since the last call.
  Index looked() { return std::exchange(looked_, 0); }

private:
  std::vector<std::pair<std::size_t, std::size_t>> pairs(const Indices<2> & rows, std::size_t there, std::size_t here) const
  {
    if (rows.shape(1) != 2)
      throw std::invalid_argument("places are of shape (K, 2)");
    std::vector<std::pair<std::size_t, std::size_t>> found;
    for (std::size_t k = 0; k < rows.shape(0); ++k)
    {
      const Index i = rows(k, 0), j = rows(k, 1);
      if (i < 0 || j < 0 || std::size_t(i) + there > q_.size() || std::size_t(j) + here > z_.size())
        throw std::out_of_range("no such coordinate");
      found.emplace_back(i, j);
    }
    return found;
  }

  const Parts parts_;
  std::vector<double> z_, q_, weights_;
  Places places_;
  States states_;
  Clearing clearing_;
  double step_;
  Index waypoint_, looked_ = 0;
  double allowed_;
};

} // namespace
