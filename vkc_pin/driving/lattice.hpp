// Numbers of nodes, which are cells and headings, where moves lead from one to the next, and what it costs to get anywhere.
#pragma once

#include <algorithm>
#include <functional>
#include <limits>
#include <queue>
#include <stdexcept>
#include <utility>
#include <vector>

#include "../distances/arrays.hpp"

constexpr Index HEADINGS = 16, BORDER = 2; // cells that moves lead out of the arena at most
constexpr Index NEVER = std::numeric_limits<Index>::max() / 4;
enum Kind : Index { AHEAD, BACK, LEFT, RIGHT, KINDS };
// What is known of a node, and of the moves ahead and to the left from it; the other two are these from their other ends.
enum Flag : std::uint8_t { BLOCKED = 1, NO_AHEAD = 2, NO_LEFT = 4, BEGINS = 8, ENDS = 16 };

// From the start to a node, or from it to a goal.
struct Connection
{
  Index node, cost;
};

// Nodes are numbered (i * cells + j) * HEADINGS + heading; here, with a border of blocked cells around these, so that no move
// leads out of them.
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

  // How many cells there are with the border.
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

  // Where a move leads if nothing is in its way.
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

// Lowers what it costs to reach each cell, by Dijkstra's algorithm: begin(reach) and moves(cell, cost, reach) call
// reach(cell, cost) where it begins, and for where moves lead from a cell.
template<typename Cost, typename Begin, typename Moves>
void spread(std::vector<Cost> & least, const Begin & begin, const Moves & moves)
{
  using Entry = std::pair<Cost, Index>;
  std::priority_queue<Entry, std::vector<Entry>, std::greater<Entry>> queue;
  const auto reach = [&](Index cell, Cost cost) {
    if (cost < least[std::size_t(cell)])
    {
      least[std::size_t(cell)] = cost;
      queue.emplace(cost, cell);
    }
  };
  begin(reach);
  while (!queue.empty())
  {
    const auto [cost, cell] = queue.top();
    queue.pop();
    if (!(cost > least[std::size_t(cell)]))
      moves(cell, cost, reach);
  }
}
