// Random numbers that do not depend on the compiler.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <random>

class Random
{
public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}

  double uniform() { return double(engine_() >> 11) * 0x1p-53; } // in [0, 1)

  std::size_t below(std::size_t count) { return std::size_t(uniform() * double(count)); }

  bool coin() { return engine_() >> 63; }

  // Standard normal distribution (Box and Muller 1958).
  double normal()
  {
    const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
    return radius * std::cos(6.283185307179586 * uniform());
  }

private:
  std::mt19937_64 engine_;
};
