// Node numbers of cells and headings, moves between them, and a search of the cheapest costs.
#pragma once

#include <algorithm>
#include <functional>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "../../world/collision/arrays.hpp"

constexpr Index HEADINGS = 16, BORDER = 2; // cells by which moves leave the arena at most
constexpr Index NEVER = std::numeric_limits<Index>::max() / 4;
enum Kind : Index { AHEAD, BACK, LEFT, RIGHT, KINDS };
// Known state of a node, and of the moves ahead and to the left from it; other moves are stored at their other ends.
enum Flag : std::uint8_t { BLOCKED = 1, NO_AHEAD = 2, NO_LEFT = 4, BEGINS = 8, ENDS = 16 };

// A connection from the start to a node, or from it to a goal.
struct Connection
{
  Index node, cost;
};

// Nodes are numbered (i * cells + j) * HEADINGS + heading, here with a border of blocked cells, so that no move leaves the array.
class Lattice
{
public:
  // `moves` in cells by heading, (16, 2).
  Lattice(Index cells, const Indices<2> & moves) : cells_(cells), width_(cells + 2 * BORDER)
  {
    if (moves.shape(0) != HEADINGS || moves.shape(1) != 2)
      throw std::invalid_argument("moves are of shape (16, 2)");
    for (Index heading = 0; heading < HEADINGS; ++heading)
    {
      const Index di = moves(heading, 0), dj = moves(heading, 1);
      if (std::max({di, -di, dj, -dj}) > BORDER)
        throw std::invalid_argument("moves lead two cells away at most");
      moves_.push_back((di * width_ + dj) * HEADINGS);
    }
  }

  // Returns the number of cells including the border.
  std::size_t size() const { return std::size_t(width_ * width_); }

  Index inner(Index node) const
  {
    if (node < 0 || node >= cells_ * cells_ * HEADINGS)
      throw std::out_of_range("no such node");
    const Index cell = node / HEADINGS;
    return ((cell / cells_ + BORDER) * width_ + cell % cells_ + BORDER) * HEADINGS + node % HEADINGS;
  }

  Index outer(Index node) const
  {
    const Index cell = node / HEADINGS;
    return ((cell / width_ - BORDER) * cells_ + cell % width_ - BORDER) * HEADINGS + node % HEADINGS;
  }

  bool border(Index node) const
  {
    const Index i = node / HEADINGS / width_ - BORDER, j = node / HEADINGS % width_ - BORDER;
    return i < 0 || j < 0 || i >= cells_ || j >= cells_;
  }

  // Returns the target of a move, whether blocked or not.
  Index target(Index node, Index kind) const
  {
    const std::uint32_t heading = std::uint32_t(node) % HEADINGS;
    if (kind == LEFT || kind == RIGHT)
      return node - heading + (heading + (kind == LEFT ? 1 : HEADINGS - 1)) % HEADINGS;
    return kind == AHEAD ? node + moves_[heading] : node - moves_[heading];
  }

private:
  Index cells_, width_;
  std::vector<Index> moves_; // in nodes, by heading
};

// Lowers the cost of each cell to that of the cheapest moves from the starting cells: moves(cell, cost, reach) calls
// reach(other, cost) for the targets of moves from a cell, each of which costs between `shortest` and `longest`.
//
// Cells wait in buckets as wide as the shortest move, without an order in a bucket (Denardo and Fox 1979). The result equals that
// of Dijkstra's algorithm bit for bit, since addition is monotonic.
template<typename Cost, typename Moves>
void spread(
  std::vector<Cost> & least, std::vector<std::pair<Cost, Index>> begins, Cost shortest, Cost longest, const Moves & moves)
{
  const double scale = 1.0 / double(shortest);
  const auto place = [scale](Cost cost) { return std::size_t(double(cost) * scale); };
  std::vector<std::vector<std::pair<Cost, Index>>> buckets(place(longest) + 3); // ring buffer
  std::size_t waiting = 0, level = 0;
  const auto reach = [&](Index cell, Cost cost) {
    if (cost < least[std::size_t(cell)])
    {
      least[std::size_t(cell)] = cost;
      buckets[place(cost) % buckets.size()].emplace_back(cost, cell);
      ++waiting;
    }
  };
  std::sort(begins.begin(), begins.end(), std::greater<>());
  for (; waiting || !begins.empty(); ++level)
  {
    if (!waiting)
      level = place(begins.back().first);
    for (; !begins.empty() && place(begins.back().first) <= level; begins.pop_back())
      reach(begins.back().second, begins.back().first);
    auto & bucket = buckets[level % buckets.size()];
    while (!bucket.empty())
    {
      const auto [cost, cell] = bucket.back();
      bucket.pop_back();
      --waiting;
      if (!(cost > least[std::size_t(cell)]))
        moves(cell, cost, reach);
    }
  }
}
