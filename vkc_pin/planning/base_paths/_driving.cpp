// Searches cheapest paths over cells and headings, and repairs them after moves turn out to be blocked, by LPA* (Koenig,
// Likhachev and Furcy 2004). Costs are integers, so that sums are exact.
// Why not SciPy: docs/decisions/0011.

#include <algorithm>
#include <queue>
#include <stdexcept>
#include <tuple>
#include <unordered_map>
#include <vector>

#include <nanobind/stl/tuple.h>

#include "floor.hpp"
#include "lattice.hpp"
#include "reeds_shepp.hpp"

namespace {

using Bytes = nb::ndarray<const std::uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

class Paths
{
public:
  // `flags` of nodes; `moves` in cells and `costs` by heading, (16, 2) and (16, 4); `begins` and `ends`: nodes and costs, (n, 2).
  Paths(
    const Bytes & flags,
    const Indices<2> & moves,
    const Indices<2> & costs,
    const Indices<2> & begins,
    const Indices<2> & ends)
  : lattice_(Index(flags.shape(0)), moves)
  {
    const std::size_t cells = flags.shape(0);
    if (flags.shape(1) != cells || flags.shape(2) != HEADINGS)
      throw std::invalid_argument("flags are of shape (cells, cells, 16)");
    if (costs.shape(0) != HEADINGS || costs.shape(1) != KINDS)
      throw std::invalid_argument("costs are of shape (16, 4)");
    if (begins.shape(1) != 2 || ends.shape(1) != 2)
      throw std::invalid_argument("connections are of shape (n, 2)");
    costs_.assign(costs.data(), costs.data() + costs.size());
    if (std::any_of(costs_.begin(), costs_.end(), [](Index cost) { return cost <= 0; }))
      throw std::invalid_argument("moves cost something");
    const std::size_t nodes = lattice_.size() * HEADINGS;
    flags_.assign(nodes, BLOCKED);
    for (std::size_t cell = 0; cell < cells * cells; ++cell)
      std::copy_n(flags.data() + cell * HEADINGS, HEADINGS, flags_.begin() + lattice_.inner(Index(cell * HEADINGS)));
    cost_.assign(nodes, NEVER);
    ahead_.assign(nodes, NEVER);
    connect(begins, begins_, begins_at_, BEGINS);
    connect(ends, ends_, ends_at_, ENDS);
    spread();
    for (const auto & begin : begins_)
      look(begin.node);
  }

  // Removes a move between two nodes, in both directions.
  void shut(Index node, Index kind)
  {
    if (kind < 0 || kind >= KINDS)
      throw std::out_of_range("no such move");
    node = lattice_.inner(node);
    const Index other = lattice_.target(node, kind);
    if (lattice_.border(other))
      return;
    const bool straight = kind == AHEAD || kind == BACK;
    flags_[kind == AHEAD || kind == LEFT ? node : other] |= straight ? NO_AHEAD : NO_LEFT;
    look(node);
    look(other);
  }

  // Removes a node.
  void block(Index node)
  {
    node = lattice_.inner(node);
    flags_[node] |= BLOCKED;
    look(node);
    for (Index kind = 0; kind < KINDS; ++kind)
      if (const Index other = lattice_.target(node, kind); !lattice_.border(other))
        look(other);
  }

  // Removes connections from the start, or to a goal, by their numbers.
  void close(const Indices<1> & numbers, bool ends)
  {
    auto & connections = ends ? ends_ : begins_;
    for (std::size_t k = 0; k < numbers.shape(0); ++k)
    {
      auto & connection = connections.at(std::size_t(numbers(k)));
      connection.cost = NEVER;
      if (!ends)
        look(connection.node);
    }
  }

  // Returns the cheapest path that costs less than `limit`: its cost, the numbers of its connections to the goal and from the
  // start, and its nodes from the goal to the start; no nodes if there is none. Ties are broken by the moves alone: at each node
  // back from the goal, the most expensive move is taken. So the result does not depend on the order of queries.
  std::tuple<Index, Index, Index, Array<Index>> cheapest(Index limit)
  {
    std::vector<Index> nodes;
    Index end = -1, begin = -1, best;
    {
      nb::gil_scoped_release released;
      best = settle(limit);
      if (best < limit)
      {
        for (std::size_t k = 0; k < ends_.size(); ++k)
          if (total(ends_[k]) == best && (end < 0 || cost_[ends_[k].node] < cost_[ends_[end].node]))
            end = Index(k);
        nodes.push_back(ends_[end].node);
        while ((begin = begun(nodes.back())) < 0)
          nodes.push_back(source(nodes.back()));
        for (Index & node : nodes)
          node = lattice_.outer(node);
      }
    }
    const std::size_t count = nodes.size();
    return {best, end, begin, handed_over(std::move(nodes), {count})};
  }

private:
  struct Entry
  {
    Index total, cost, node;
    bool operator<(const Entry & other) const { return std::tie(total, cost) > std::tie(other.total, other.cost); }
  };

  using At = std::unordered_map<Index, std::vector<std::size_t>>;

  void connect(const Indices<2> & given, std::vector<Connection> & connections, At & at, Flag flag)
  {
    for (std::size_t k = 0; k < given.shape(0); ++k)
    {
      const Index node = lattice_.inner(given(k, 0));
      connections.push_back({node, given(k, 1)});
      at[node].push_back(k);
      flags_[node] |= flag;
    }
  }

  // Computes the heuristic: the cost from each cell to the goals if turning is free.
  void spread()
  {
    least_.assign(lattice_.size(), NEVER);
    std::vector<std::pair<Index, Index>> first;
    for (const auto & end : ends_)
      first.emplace_back(end.cost, end.node / HEADINGS);
    Index shortest = NEVER, longest = 0;
    for (Index heading = 0; heading < HEADINGS; ++heading)
      for (const Index kind : {AHEAD, BACK})
      {
        shortest = std::min(shortest, price(heading, kind));
        longest = std::max(longest, price(heading, kind));
      }
    ::spread(least_, std::move(first), shortest, longest, [&](Index cell, Index cost, const auto & reach) {
      for (Index node = cell * HEADINGS; node < (cell + 1) * HEADINGS; ++node)
        for (const Index kind : {AHEAD, BACK})
          if (const Index from = leads(node, opposite(kind)); from >= 0)
            reach(from / HEADINGS, cost + price(from, kind));
    });
  }

  // Returns the target of a move; negative if the move is known to be blocked.
  Index leads(Index node, Index kind) const
  {
    if (flags_[node] & BLOCKED)
      return -1;
    const Index other = lattice_.target(node, kind);
    const std::uint8_t first = flags_[kind == AHEAD || kind == LEFT ? node : other];
    return flags_[other] & BLOCKED || first & (kind < LEFT ? NO_AHEAD : NO_LEFT) ? -1 : other;
  }

  static Index opposite(Index kind) { return kind ^ 1; }

  Index price(Index from, Index kind) const { return costs_[std::size_t(from % HEADINGS * KINDS + kind)]; }

  Index total(const Connection & end) const { return std::min(cost_[end.node] + end.cost, NEVER); }

  // Updates the cost of a node from its predecessors.
  void look(Index node)
  {
    Index least = NEVER;
    if (!(flags_[node] & BLOCKED))
    {
      if (flags_[node] & BEGINS)
        for (const std::size_t k : begins_at_[node])
          least = std::min(least, begins_[k].cost);
      for (Index kind = 0; kind < KINDS; ++kind)
        if (const Index from = leads(node, opposite(kind)); from >= 0)
          least = std::min(least, cost_[from] + price(from, kind));
    }
    ahead_[node] = least;
    push(node);
  }

  void push(Index node)
  {
    const Index least = least_[node / HEADINGS], cost = std::min(cost_[node], ahead_[node]);
    if (cost_[node] != ahead_[node] && least < NEVER)
      queue_.push({cost + least, cost, node});
  }

  // Returns the cost of the cheapest path, or `limit`; then all nodes on paths up to that cost are consistent.
  Index settle(Index limit)
  {
    Index best = cheapest_end(limit);
    while (!queue_.empty() && queue_.top().total <= best)
    {
      const Entry entry = queue_.top();
      queue_.pop();
      const Index node = entry.node, before = cost_[node];
      if (before == ahead_[node] || entry.cost != std::min(before, ahead_[node]))
        continue; // an obsolete entry
      if (before > ahead_[node])
      {
        const Index cost = cost_[node] = ahead_[node];
        if (flags_[node] & ENDS)
          for (const std::size_t k : ends_at_[node])
            best = std::min(best, total(ends_[k]));
        for (Index kind = 0; kind < KINDS; ++kind)
          if (const Index other = leads(node, kind); other >= 0 && cost + price(node, kind) < ahead_[other])
          {
            ahead_[other] = cost + price(node, kind);
            push(other);
          }
      }
      else
      {
        cost_[node] = NEVER;
        push(node);
        for (Index kind = 0; kind < KINDS; ++kind)
          if (const Index other = leads(node, kind); other >= 0 && before + price(node, kind) == ahead_[other])
            look(other);
        if (flags_[node] & ENDS)
          best = cheapest_end(limit);
      }
    }
    return best;
  }

  Index cheapest_end(Index limit) const
  {
    for (const auto & end : ends_)
      limit = std::min(limit, total(end));
    return limit;
  }

  // Returns the last connection from the start that explains the cost of a node; negative: none.
  Index begun(Index node)
  {
    Index found = -1;
    if (flags_[node] & BEGINS)
      for (const std::size_t k : begins_at_[node])
        if (begins_[k].cost == cost_[node])
          found = Index(k);
    return found;
  }

  // Returns the predecessor of a node on the cheapest path to it.
  Index source(Index node) const
  {
    Index found = -1;
    for (Index kind = 0; kind < KINDS; ++kind)
      if (const Index from = leads(node, opposite(kind)); from >= 0 && cost_[from] + price(from, kind) == cost_[node])
        if (found < 0 || cost_[from] <= cost_[found])
          found = from;
    if (found < 0)
      throw std::logic_error("a path that comes from nowhere");
    return found;
  }

  Lattice lattice_;
  std::vector<Index> least_, costs_; // by cell; by heading and kind
  std::vector<std::uint8_t> flags_;
  std::vector<Index> cost_, ahead_; // from the start; one-step lookahead
  std::vector<Connection> begins_, ends_;
  At begins_at_, ends_at_; // by node
  std::priority_queue<Entry> queue_;
};

} // namespace

NB_MODULE(_driving, module)
{
  module.doc() = "Cheapest paths over cells and headings, found again after moves have turned out not to be free; paths of cars.";
  nb::set_leak_warnings(false); // caches and globals live until the process ends
  nb::class_<Paths>(module, "Paths")
    .def(nb::init<const Bytes &, const Indices<2> &, const Indices<2> &, const Indices<2> &, const Indices<2> &>())
    .def("shut", &Paths::shut)
    .def("block", &Paths::block)
    .def("close", &Paths::close)
    .def("cheapest", &Paths::cheapest);
  nb::class_<Floor>(module, "Floor")
    .def(nb::init<const Bytes &, const Indices<2> &, const Numbers<1> &>())
    .def("distances", &Floor::distances);
  module.def("shortest_words", &reeds_shepp::shortest_words);
}
