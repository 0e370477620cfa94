// Shortest paths of a car that drives forwards and backwards, in closed form; see reeds_shepp.py for the source.

#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "../../world/collision/arrays.hpp"

namespace reeds_shepp {

constexpr std::size_t MOST = 5; // pieces of a word
constexpr double SAME = 1e-9, PI = 3.14159265358979323846, QUARTER = PI / 2;

// Lengths of pieces in radii, backwards < 0, and their turning directions: left 1, right -1, straight 0.
struct Word
{
  std::array<double, MOST> pieces{};
  std::array<int, MOST> ways{};
  double length = std::numeric_limits<double>::infinity();
};

using Pieces = std::array<double, MOST>;

inline double wrapped(double angle)
{
  return std::remainder(angle, 2.0 * PI);
}

inline double root(double square)
{
  return std::sqrt(std::max(square, 0.0));
}

// A goal: position, heading, and the heading's sine and cosine.
struct Goal
{
  double x, y, phi, sin, cos;
};

// Each formula returns whether a word of its kind reaches a goal, and the word's pieces.
using Formula = bool (*)(const Goal & goal, Pieces & p);

inline bool lsl(const Goal & goal, Pieces & p)
{
  const double a = goal.x - goal.sin, b = goal.y - 1.0 + goal.cos, t = std::atan2(b, a), v = wrapped(goal.phi - t);
  p = {t, std::hypot(a, b), v};
  return t >= -SAME && v >= -SAME;
}

inline bool lsr(const Goal & goal, Pieces & p)
{
  const double a = goal.x + goal.sin, b = goal.y - 1.0 - goal.cos, far = std::hypot(a, b), u = root(far * far - 4.0);
  const double t = wrapped(std::atan2(b, a) + std::atan2(2.0, u)), v = wrapped(t - goal.phi);
  p = {t, u, v};
  return far >= 2.0 && t >= -SAME && v >= -SAME;
}

inline bool lrl(const Goal & goal, Pieces & p)
{
  const double a = goal.x - goal.sin, b = goal.y - 1.0 + goal.cos, far = std::hypot(a, b);
  const double u = -2.0 * std::asin(std::min(far / 4.0, 1.0));
  const double t = wrapped(std::atan2(b, a) + u / 2 + PI), v = wrapped(goal.phi - t + u);
  p = {t, u, v};
  return far <= 4.0 && t >= -SAME && u <= SAME;
}

// The first and the last arc of words with two arcs u and v between them.
inline std::array<double, 2> outer(double u, double v, double xi, double eta, double phi)
{
  const double delta = wrapped(u - v), a = std::sin(u) - std::sin(delta), b = std::cos(u) - std::cos(delta) - 1.0;
  const double t = std::atan2(eta * a - xi * b, xi * a + eta * b);
  const bool beyond = 2.0 * (std::cos(delta) - std::cos(v) - std::cos(u)) + 3.0 < 0.0;
  const double first = wrapped(beyond ? t + PI : t);
  return {first, wrapped(first - u + v - phi)};
}

// L+ R+ L- R-, equal middle arcs.
inline bool lrlr_between(const Goal & goal, Pieces & p)
{
  const double xi = goal.x + goal.sin, eta = goal.y - 1.0 - goal.cos, rho = (2.0 + std::hypot(xi, eta)) / 4.0;
  const double u = std::acos(std::min(rho, 1.0));
  const auto [t, v] = outer(u, -u, xi, eta, goal.phi);
  p = {t, u, -u, v};
  return rho <= 1.0 && t >= -SAME && v <= SAME;
}

// L+ R- L- R+, equal middle arcs.
inline bool lrlr_within(const Goal & goal, Pieces & p)
{
  const double xi = goal.x + goal.sin, eta = goal.y - 1.0 - goal.cos, rho = (20.0 - xi * xi - eta * eta) / 16.0;
  const double u = -std::acos(std::clamp(rho, -1.0, 1.0));
  const auto [t, v] = outer(u, u, xi, eta, goal.phi);
  p = {t, u, u, v};
  return rho >= 0.0 && rho <= 1.0 && u >= -QUARTER && t >= -SAME && v >= -SAME;
}

inline bool lrsl(const Goal & goal, Pieces & p)
{
  const double a = goal.x - goal.sin, b = goal.y - 1.0 + goal.cos, far = std::hypot(a, b), straight = root(far * far - 4.0);
  const double u = 2.0 - straight, t = wrapped(std::atan2(b, a) + std::atan2(straight, -2.0));
  const double v = wrapped(goal.phi - QUARTER - t);
  p = {t, -QUARTER, u, v};
  return far >= 2.0 && t >= -SAME && u <= SAME && v <= SAME;
}

inline bool lrsr(const Goal & goal, Pieces & p)
{
  const double a = -(goal.y - 1.0 - goal.cos), b = goal.x + goal.sin, far = std::hypot(a, b), t = std::atan2(b, a);
  const double u = 2.0 - far, v = wrapped(t + QUARTER - goal.phi);
  p = {t, -QUARTER, u, v};
  return far >= 2.0 && t >= -SAME && u <= SAME && v <= SAME;
}

inline bool lrslr(const Goal & goal, Pieces & p)
{
  const double xi = goal.x + goal.sin, eta = goal.y - 1.0 - goal.cos, far = std::hypot(xi, eta);
  const double u = 4.0 - root(far * far - 4.0);
  const double t = wrapped(std::atan2((4.0 - u) * xi - 2.0 * eta, -2.0 * xi + (u - 4.0) * eta)), v = wrapped(t - goal.phi);
  p = {t, -QUARTER, u, -QUARTER, v};
  return far >= 2.0 && u <= SAME && t >= -SAME && v >= -SAME;
}

// A formula, the turning directions of its pieces, their number, and whether the reversed word is another one.
struct Kind
{
  Formula formula;
  std::array<int, MOST> ways;
  std::size_t count;
  bool reverses;
};

constexpr std::array<Kind, 8> KINDS{{
  {lsl, {1, 0, 1}, 3, false},
  {lsr, {1, 0, -1}, 3, false},
  {lrl, {1, -1, 1}, 3, true},
  {lrlr_between, {1, -1, 1, -1}, 4, false},
  {lrlr_within, {1, -1, 1, -1}, 4, false},
  {lrsl, {1, -1, 0, 1}, 4, true},
  {lrsr, {1, -1, 0, -1}, 4, true},
  {lrslr, {1, -1, 0, 1, -1}, 5, false},
}};

inline Word shortest(double x, double y, double phi)
{
  // The start relative to the goal, mirrored.
  const double sin = std::sin(phi), cos = std::cos(phi), back_x = x * cos + y * sin, back_y = x * sin - y * cos;
  Word best;
  Pieces pieces;
  for (const auto & kind : KINDS)
    for (const bool reverse : {false, true})
    {
      if (reverse && !kind.reverses)
        continue;
      for (const int flip : {1, -1}) // time reversal
        for (const int mirror : {1, -1})
        {
          const double px = reverse ? back_x : x, py = reverse ? back_y : y;
          if (!kind.formula({flip * px, mirror * py, flip * mirror * phi, flip * mirror * sin, cos}, pieces))
            continue;
          double length = 0.0;
          for (std::size_t k = 0; k < kind.count; ++k)
            length += std::abs(pieces[k]);
          if (!(length < best.length))
            continue;
          best = {{}, {}, length};
          for (std::size_t k = 0; k < kind.count; ++k)
          {
            const std::size_t at = reverse ? kind.count - 1 - k : k;
            best.pieces[k] = flip * pieces[at];
            best.ways[k] = mirror * kind.ways[at];
          }
        }
    }
  return best;
}

// Shortest paths of a car to goals, (n, 3), in radii: lengths and turns of their pieces, (n, 5, 2).
inline Array<double> shortest_words(const Numbers<2> & goals)
{
  if (goals.shape(1) != 3)
    throw std::invalid_argument("goals are of shape (n, 3)");
  std::vector<double> found;
  found.reserve(goals.shape(0) * MOST * 2);
  for (std::size_t i = 0; i < goals.shape(0); ++i)
  {
    const auto word = shortest(goals(i, 0), goals(i, 1), goals(i, 2));
    for (std::size_t k = 0; k < MOST; ++k)
    {
      found.push_back(word.pieces[k]);
      found.push_back(word.ways[k] * word.pieces[k]);
    }
  }
  return handed_over(std::move(found), {goals.shape(0), MOST, 2});
}

} // namespace reeds_shepp
