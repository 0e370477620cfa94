// Straight lines between configurations of a robot: what searches ask, whoever answers.
#pragma once

#include <cstddef>

namespace vkc_pin {

struct StraightLines
{
  virtual ~StraightLines() = default;

  virtual std::size_t size() const = 0; // coordinates of the robot

  // Which share of the line from one configuration to another is free, up to the last that is looked at before the first that is not.
  virtual double free(const double * from, const double * to) = 0;
};

constexpr const char * STRAIGHT_LINES = "vkc_pin.StraightLines"; // of capsules that carry a pointer to such

} // namespace vkc_pin
