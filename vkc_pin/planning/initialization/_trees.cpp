// Grows two random trees towards each other (RRT-Connect, Kuffner and LaValle, ICRA 2000); see rrt.py.
// Why not OMPL: docs/decisions/0012.

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <limits>
#include <random>
#include <utility>
#include <vector>

#include "../../world/collision/arrays.hpp"
#include "../../world/collision/straight.hpp"

namespace {

using Row = std::vector<double>;
using Rows = std::vector<Row>;

constexpr std::size_t BASE = 3; // x, y and yaw come first
constexpr std::size_t NONE = std::numeric_limits<std::size_t>::max();

// Random numbers that do not depend on the compiler.
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

struct Tree
{
  Tree(const Rows & roots, std::size_t sections)
  : nodes(roots), parents(roots.size(), NONE), has_section(sections, false)
  {
  }

  std::size_t add(const Row & node, std::size_t parent)
  {
    nodes.push_back(node);
    parents.push_back(parent);
    return nodes.size() - 1;
  }

  Rows trace_to_root(std::size_t node) const
  {
    Rows path;
    for (; node != NONE; node = parents[node])
      path.push_back(nodes[node]);
    return path;
  }

  Rows nodes;
  std::vector<std::size_t> parents;
  std::vector<bool> has_section;
};

Row interpolate(const Row & a, const Row & b, double share)
{
  Row row(a.size());
  for (std::size_t k = 0; k < a.size(); ++k)
    row[k] = share >= 1.0 ? b[k] : a[k] + share * (b[k] - a[k]);
  return row;
}

// Returns the piece of a path at a length along it; the last one at its end.
std::size_t find_piece(const Row & lengths, double at)
{
  const auto after = std::upper_bound(lengths.begin(), lengths.end(), at);
  return std::min(std::size_t(std::max<std::ptrdiff_t>(after - lengths.begin() - 1, 0)), lengths.size() - 2);
}

Row interpolate_path(const Rows & path, const Row & lengths, double at)
{
  const std::size_t k = find_piece(lengths, at);
  const double length = lengths[k + 1] - lengths[k];
  return interpolate(path[k], path[k + 1], length > 0.0 ? std::clamp((at - lengths[k]) / length, 0.0, 1.0) : 1.0);
}

Row to_row(const Numbers<1> & numbers) { return Row(numbers.data(), numbers.data() + numbers.shape(0)); }

Rows to_rows(const Numbers<2> & numbers)
{
  Rows rows;
  for (std::size_t k = 0; k < numbers.shape(0); ++k)
    rows.emplace_back(numbers.data() + k * numbers.shape(1), numbers.data() + (k + 1) * numbers.shape(1));
  return rows;
}

Array<double> to_array(const Rows & rows, std::size_t columns)
{
  std::vector<double> numbers;
  for (const Row & row : rows)
    numbers.insert(numbers.end(), row.begin(), row.end());
  return handed_over(std::move(numbers), {rows.size(), columns});
}

// Not thread-safe: one thread at a time. rrt.py guarantees the shapes of all arrays.
class Trees
{
public:
  Trees(
    nb::object checker,
    const Numbers<1> & weights,
    const Numbers<1> & lower,
    const Numbers<1> & upper,
    const Numbers<2> & poses,
    const Numbers<2> & arms,
    const Numbers<2> & sections,
    const Indices<1> & lengths,
    double path_spread,
    double end_spread,
    std::uint64_t seed)
  : owner_(std::move(checker)),
    lines_(static_cast<vkc_pin::StraightLines *>(nb::cast<nb::capsule>(owner_.attr("straight")()).data(vkc_pin::STRAIGHT_LINES))),
    weights_(to_row(weights)), lower_(to_row(lower)), upper_(to_row(upper)), poses_(to_rows(poses)), arms_(to_rows(arms)),
    path_spread_(path_spread), end_spread_(end_spread), random_(seed)
  {
    const Rows rows = to_rows(sections);
    auto row = rows.begin();
    for (std::size_t k = 0; k < lengths.shape(0); row += lengths(k++))
      sections_.emplace_back(row, row + lengths(k));
  }

  // Returns a path from `start` to one of `ends`, empty if none was found.
  Array<double> run(const Numbers<2> & start, const Numbers<2> & ends, Index max_extensions)
  {
    const Rows first = to_rows(start), last = to_rows(ends);
    Rows path;
    {
      nb::gil_scoped_release released;
      path = connect(first, last, max_extensions);
    }
    return to_array(path, weights_.size());
  }

  // Applies shortcuts between random points of a path, as many times as it has configurations.
  Array<double> shortened(const Numbers<2> & path)
  {
    return change(path, [this](Rows & rows) {
      for (std::size_t k = rows.size(); k > 0 && rows.size() > 2; --k)
      {
        const double from = random_.uniform(), to = random_.uniform();
        apply_shortcut(rows, from, to);
      }
    });
  }

  // Applies partial shortcuts to the arm and to each of its joints: along the whole path (`rounds` 0) or between random points.
  Array<double> evened(const Numbers<2> & path, Index rounds, double min_saving)
  {
    return change(path, [&](Rows & rows) {
      const std::size_t joints = weights_.size() - BASE;
      for (Index round = 0; round < std::max<Index>(rounds, 1); ++round)
        for (std::size_t group = 0; group <= joints; ++group)
        {
          const std::size_t first = group ? BASE + group - 1 : BASE, last = group ? first + 1 : BASE + joints;
          const double from = rounds ? random_.uniform() : 0.0, to = rounds ? random_.uniform() : 1.0;
          apply_partial_shortcut(rows, first, last, from, to, min_saving);
        }
    });
  }

  // Returns the collision-free share of the line between two configurations.
  double along(const Numbers<2> & ends) { return lines_->free(ends.data(), ends.data() + ends.shape(1)); }

private:
  template<typename Change>
  Array<double> change(const Numbers<2> & path, const Change & apply)
  {
    Rows rows = to_rows(path);
    {
      nb::gil_scoped_release released;
      apply(rows);
    }
    return to_array(rows, weights_.size());
  }

  double square_distance(const Row & a, const Row & b) const
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
  Row accumulate_lengths(const Rows & path) const
  {
    Row lengths(path.size(), 0.0);
    for (std::size_t k = 1; k < path.size(); ++k)
      lengths[k] = lengths[k - 1] + std::sqrt(square_distance(path[k - 1], path[k]));
    return lengths;
  }

  // Replaces a part of a path by a straight line if that is collision-free.
  void apply_shortcut(Rows & path, double from, double to)
  {
    const Row lengths = accumulate_lengths(path);
    const double s = std::min(from, to) * lengths.back(), t = std::max(from, to) * lengths.back();
    const std::size_t i = find_piece(lengths, s), j = find_piece(lengths, t);
    if (i == j)
      return;
    const Row a = interpolate_path(path, lengths, s), b = interpolate_path(path, lengths, t);
    if (lines_->free(a.data(), b.data()) < 1.0)
      return;
    path.erase(path.begin() + std::ptrdiff_t(i) + 1, path.begin() + std::ptrdiff_t(j) + 1);
    path.insert(path.begin() + std::ptrdiff_t(i) + 1, {a, b});
  }

  // Moves some coordinates evenly along a part of a path if that saves the given share of its length and is collision-free.
  void apply_partial_shortcut(Rows & path, std::size_t first, std::size_t last, double from, double to, double min_saving)
  {
    if (path.size() < 2)
      return;
    const Row lengths = accumulate_lengths(path);
    const double s = std::min(from, to) * lengths.back(), t = std::max(from, to) * lengths.back();
    Rows part{interpolate_path(path, lengths, s)};
    Row at{s};
    for (std::size_t k = 0; k < path.size(); ++k)
      if (s < lengths[k] && lengths[k] < t)
      {
        part.push_back(path[k]);
        at.push_back(lengths[k]);
      }
    part.push_back(interpolate_path(path, lengths, t));
    for (std::size_t k = 1; k + 1 < part.size(); ++k)
      for (std::size_t column = first; column < last; ++column)
        part[k][column] = part[0][column] + (at[k] - s) / std::max(t - s, 1e-12) * (part.back()[column] - part[0][column]);
    Rows changed;
    const auto add = [&](const Row & row) {
      if (changed.empty() || square_distance(changed.back(), row) > 0.0)
        changed.push_back(row);
    };
    for (std::size_t k = 0; k < path.size() && lengths[k] <= s; ++k)
      add(path[k]);
    for (const Row & row : part)
      add(row);
    for (std::size_t k = 0; k < path.size(); ++k)
      if (lengths[k] >= t)
        add(path[k]);
    if (accumulate_lengths(changed).back() >= (1.0 - min_saving) * lengths.back())
      return;
    for (std::size_t k = 1; k < part.size(); ++k)
      if (lines_->free(part[k - 1].data(), part[k].data()) < 1.0)
        return;
    path = std::move(changed);
  }

  Rows connect(const Rows & start, const Rows & ends, Index max_extensions)
  {
    Tree trees[] = {Tree(start, sections_.size()), Tree(ends, sections_.size())};
    std::deque<Row> direct(ends.begin(), ends.end());
    for (Index extension = 1; extension <= max_extensions; ++extension)
    {
      const bool forwards = !direct.empty() || extension % 2 == 0;
      Tree &tree = trees[forwards ? 0 : 1], &other = trees[forwards ? 1 : 0];
      std::size_t node = NONE;
      if (!direct.empty())
      {
        node = grow(tree, direct.front());
        direct.pop_front();
      }
      else if (random_.coin() && std::count(tree.has_section.begin(), tree.has_section.end(), false) > 0)
        node = grow_to_section(tree);
      else
        node = grow(tree, sample(start, ends));
      if (node == NONE)
        continue;
      const Row goal = tree.nodes[node];
      const std::size_t met = grow(other, goal);
      if (met == NONE || other.nodes[met] != goal)
        continue;
      Rows path = trees[0].trace_to_root(forwards ? node : met), rest = trees[1].trace_to_root(forwards ? met : node);
      std::reverse(path.begin(), path.end());
      path.insert(path.end(), rest.begin() + 1, rest.end()); // both contain where they meet
      return path;
    }
    return {};
  }

  // Grows a tree towards a free section of the base's path, and adds the whole section if it gets there.
  std::size_t grow_to_section(Tree & tree)
  {
    std::vector<std::size_t> left;
    for (std::size_t k = 0; k < sections_.size(); ++k)
      if (!tree.has_section[k])
        left.push_back(k);
    const std::size_t number = left[random_.below(left.size())];
    const Rows & rows = sections_[number];
    const std::size_t at = random_.below(rows.size());
    const std::size_t node = grow(tree, rows[at]);
    if (node != NONE && tree.nodes[node] == rows[at])
    {
      tree.has_section[number] = true;
      for (std::size_t k = at + 1, parent = node; k < rows.size(); ++k)
        parent = tree.add(rows[k], parent);
      for (std::size_t k = at, parent = node; k > 0; --k)
        parent = tree.add(rows[k - 1], parent);
    }
    return node;
  }

  // Samples a configuration near the base's path or one of its ends, with the arm at or near a likely posture.
  Row sample(const Rows & start, const Rows & ends)
  {
    const bool guided = random_.coin();
    const Rows & poses = guided ? poses_ : random_.coin() ? ends : start;
    const Row &pose = poses[random_.below(poses.size())], &arm = arms_[random_.below(arms_.size())];
    Row goal(pose.begin(), pose.begin() + BASE);
    goal.insert(goal.end(), arm.begin(), arm.end());
    const double base = random_.uniform() * (guided ? path_spread_ : end_spread_);
    const double joints = random_.coin() ? random_.uniform() * end_spread_ : 0.0;
    for (std::size_t k = 0; k < goal.size(); ++k)
      goal[k] = std::min(std::max(goal[k] + (k < BASE ? base : joints) * random_.normal(), lower_[k]), upper_[k]);
    return goal;
  }

  // Extends a tree from its nearest node towards a configuration until a collision; returns the new node, if any.
  std::size_t grow(Tree & tree, const Row & goal)
  {
    std::size_t near = 0;
    double least = std::numeric_limits<double>::infinity();
    for (std::size_t k = 0; k < tree.nodes.size(); ++k)
      if (const double square = square_distance(tree.nodes[k], goal); square < least)
      {
        near = k;
        least = square;
      }
    if (tree.nodes[near] == goal)
      return near;
    const double reached = lines_->free(tree.nodes[near].data(), goal.data());
    return reached > 0.0 ? tree.add(interpolate(tree.nodes[near], goal, reached), near) : NONE;
  }

  nb::object owner_; // of the lines
  vkc_pin::StraightLines * lines_;
  Row weights_, lower_, upper_;
  Rows poses_, arms_;
  std::vector<Rows> sections_;
  double path_spread_, end_spread_;
  Random random_;
};

} // namespace

NB_MODULE(_trees, module)
{
  module.doc() = "Two random trees of configurations that grow towards each other, and shortcuts of their paths.";
  nb::set_leak_warnings(false); // caches and globals live until the process ends
  nb::class_<Trees>(module, "Trees")
    .def(
      nb::init<
        nb::object,
        const Numbers<1> &,
        const Numbers<1> &,
        const Numbers<1> &,
        const Numbers<2> &,
        const Numbers<2> &,
        const Numbers<2> &,
        const Indices<1> &,
        double,
        double,
        std::uint64_t>())
    .def("run", &Trees::run)
    .def("shortened", &Trees::shortened)
    .def("evened", &Trees::evened)
    .def("along", &Trees::along);
}
