// A tree of configurations.
#pragma once

#include <cstddef>
#include <limits>
#include <vector>

#include "paths.hpp"

constexpr std::size_t NONE = std::numeric_limits<std::size_t>::max();

// Nodes with their parents.
class Tree
{
public:
  Tree(const Rows & roots, std::size_t runs) : nodes(roots), taken(runs, false), parents_(roots.size(), NONE) {}

  std::size_t nearest(const Row & goal, const Measure & measure) const
  {
    std::size_t best = 0;
    double least = std::numeric_limits<double>::infinity();
    for (std::size_t k = 0; k < nodes.size(); ++k)
      if (const double square = measure.square(nodes[k], goal); square < least)
      {
        best = k;
        least = square;
      }
    return best;
  }

  std::size_t add(const Row & node, std::size_t parent)
  {
    nodes.push_back(node);
    parents_.push_back(parent);
    return nodes.size() - 1;
  }

  // Returns the path from a node to its root.
  Rows back(std::size_t node) const
  {
    Rows found;
    for (; node != NONE; node = parents_[node])
      found.push_back(nodes[node]);
    return found;
  }

  Rows nodes;
  std::vector<bool> taken; // which runs it contains

private:
  std::vector<std::size_t> parents_;
};
