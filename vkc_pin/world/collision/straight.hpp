// Interface of collision checkers for straight lines between configurations, as used by sampling-
// based searches.
#pragma once

#include <cstddef>

namespace vkc_pin {

struct StraightLines
{
  virtual ~StraightLines() = default;

  virtual std::size_t size() const = 0; // coordinates of the robot

  // Returns the collision-free fraction of a line, up to the last check before the first collision.
  virtual double free(const double * from, const double * to) = 0;
};

constexpr const char * STRAIGHT_LINES = "vkc_pin.StraightLines"; // name of capsules that hold a pointer to a checker

} // namespace vkc_pin
