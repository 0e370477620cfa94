// Grows two random trees towards each other (RRT-Connect, Kuffner and LaValle, ICRA 2000); see rrt.py.

#include <deque>
#include <stdexcept>
#include <utility>


#include "../../world/collision/arrays.hpp"
#include "paths.hpp"
#include "random.hpp"
#include "tree.hpp"

namespace {

constexpr std::size_t BASE = 3; // x, y and yaw come first

Rows rows_of(const Numbers<2> & numbers)
{
  Rows found;
  for (std::size_t k = 0; k < numbers.shape(0); ++k)
    found.emplace_back(numbers.data() + k * numbers.shape(1), numbers.data() + (k + 1) * numbers.shape(1));
  return found;
}

// Not thread-safe: one thread at a time.
class Trees
{
public:
  Trees(
    nb::object lines,
    const Numbers<1> & weights,
    const Numbers<1> & lower,
    const Numbers<1> & upper,
    const Numbers<2> & poses,
    const Numbers<2> & arms,
    const Numbers<2> & runs,
    const Indices<1> & lengths,
    double beside,
    double around,
    std::uint64_t seed)
  : kept_(std::move(lines)),
    lines_(static_cast<vkc_pin::StraightLines *>(nb::cast<nb::capsule>(kept_.attr("straight")()).data(vkc_pin::STRAIGHT_LINES))),
    measure_(Row(weights.data(), weights.data() + weights.shape(0))), lower_(lower.data(), lower.data() + lower.shape(0)),
    upper_(upper.data(), upper.data() + upper.shape(0)), poses_(rows_of(poses)), arms_(rows_of(arms)), beside_(beside),
    around_(around), random_(seed)
  {
    const std::size_t size = lines_->size();
    if (
      weights.shape(0) != size || lower.shape(0) != size || upper.shape(0) != size || poses.shape(1) != BASE || size < BASE
      || arms.shape(1) != size - BASE || runs.shape(1) != size || poses_.empty() || arms_.empty())
      throw std::invalid_argument("weights, limits, poses, arms and runs are of the robot's coordinates");
    Rows rows = rows_of(runs);
    auto row = rows.begin();
    for (std::size_t k = 0; k < lengths.shape(0); ++k)
    {
      if (lengths(k) < 1 || lengths(k) > rows.end() - row)
        throw std::invalid_argument("runs are as long as is said");
      runs_.emplace_back(row, row + lengths(k));
      row += lengths(k);
    }
  }

  // Returns a path from `start` to one of `ends`, empty if none was found.
  Array<double> run(const Numbers<2> & start, const Numbers<2> & ends, Index tries)
  {
    check(start);
    check(ends);
    if (start.shape(0) != 1)
      throw std::invalid_argument("paths begin at one configuration");
    const Rows first = rows_of(start), last = rows_of(ends);
    Rows path;
    {
      nb::gil_scoped_release released;
      path = grow_until_they_meet(first, last, tries);
    }
    return array(path);
  }

  // Applies shortcuts between random points of a path, as many times as it has configurations.
  Array<double> shortened(const Numbers<2> & path)
  {
    return changed(path, [this](Rows & rows) {
      for (std::size_t k = rows.size(); k > 0 && rows.size() > 2; --k)
      {
        const double from = random_.uniform(), to = random_.uniform();
        shorten(*lines_, measure_, rows, from, to);
      }
    });
  }

  // Applies partial shortcuts to the arm and to each of its joints: along the whole path (`times` 0) or between random points.
  Array<double> evened(const Numbers<2> & path, Index times, double worth)
  {
    return changed(path, [&](Rows & rows) {
      const std::size_t joints = lines_->size() - BASE;
      for (Index turn = 0; turn < std::max<Index>(times, 1); ++turn)
        for (std::size_t group = 0; group <= joints; ++group)
        {
          std::vector<std::size_t> columns;
          for (std::size_t joint = 0; joint < joints; ++joint)
            if (group == 0 || joint + 1 == group)
              columns.push_back(BASE + joint);
          const double from = times ? random_.uniform() : 0.0, to = times ? random_.uniform() : 1.0;
          make_even(*lines_, measure_, rows, columns, from, to, worth);
        }
    });
  }

  // Returns the collision-free share of the line between two configurations.
  double along(const Numbers<2> & ends)
  {
    check(ends);
    if (ends.shape(0) != 2)
      throw std::invalid_argument("a line has two ends");
    return lines_->free(ends.data(), ends.data() + ends.shape(1));
  }

private:
  void check(const Numbers<2> & rows) const
  {
    if (rows.shape(1) != lines_->size() || rows.shape(0) < 1)
      throw std::invalid_argument("configurations are of the robot's coordinates");
  }

  Array<double> array(const Rows & rows) const
  {
    std::vector<double> numbers;
    for (const Row & row : rows)
      numbers.insert(numbers.end(), row.begin(), row.end());
    return handed_over(std::move(numbers), {rows.size(), lines_->size()});
  }

  template<typename Change>
  Array<double> changed(const Numbers<2> & path, const Change & change)
  {
    check(path);
    Rows rows = rows_of(path);
    {
      nb::gil_scoped_release released;
      change(rows);
    }
    return array(rows);
  }

  Rows grow_until_they_meet(const Rows & start, const Rows & ends, Index tries)
  {
    Tree trees[] = {Tree(start, runs_.size()), Tree(ends, runs_.size())};
    std::deque<Row> direct(ends.begin(), ends.end());
    for (Index grown = 1; grown <= tries; ++grown)
    {
      const bool forwards = !direct.empty() || grown % 2 == 0;
      Tree &tree = trees[forwards ? 0 : 1], &other = trees[forwards ? 1 : 0];
      std::size_t node = NONE;
      if (!direct.empty())
      {
        node = grow(tree, direct.front());
        direct.pop_front();
      }
      else if (random_.coin() && std::count(tree.taken.begin(), tree.taken.end(), false) > 0)
        node = grow_to_run(tree);
      else
        node = grow(tree, drawn(start, ends));
      if (node == NONE)
        continue;
      const Row goal = tree.nodes[node];
      const std::size_t met = grow(other, goal);
      if (met == NONE || other.nodes[met] != goal)
        continue;
      Rows there = trees[0].back(forwards ? node : met), back = trees[1].back(forwards ? met : node);
      std::reverse(there.begin(), there.end());
      there.insert(there.end(), back.begin() + 1, back.end()); // both have where they meet
      return there;
    }
    return {};
  }

  // Grows a tree towards a free run of the base's path, and adds the whole run if it gets there.
  std::size_t grow_to_run(Tree & tree)
  {
    std::vector<std::size_t> left;
    for (std::size_t k = 0; k < runs_.size(); ++k)
      if (!tree.taken[k])
        left.push_back(k);
    const std::size_t number = left[random_.below(left.size())];
    const Rows & rows = runs_[number];
    const std::size_t at = random_.below(rows.size());
    const std::size_t node = grow(tree, rows[at]);
    if (node != NONE && tree.nodes[node] == rows[at])
    {
      tree.taken[number] = true;
      for (std::size_t k = at + 1, parent = node; k < rows.size(); ++k)
        parent = tree.add(rows[k], parent);
      for (std::size_t k = at, parent = node; k > 0; --k)
        parent = tree.add(rows[k - 1], parent);
    }
    return node;
  }

  // Samples a configuration near the base's path or one of its ends, with the arm at or near a likely posture.
  Row drawn(const Rows & start, const Rows & ends)
  {
    const bool guided = random_.coin();
    const Rows & poses = guided ? poses_ : random_.coin() ? ends : start;
    const Row &pose = poses[random_.below(poses.size())], &arm = arms_[random_.below(arms_.size())];
    Row goal(pose.begin(), pose.begin() + BASE);
    goal.insert(goal.end(), arm.begin(), arm.end());
    const double base = random_.uniform() * (guided ? beside_ : around_);
    const double joints = random_.coin() ? random_.uniform() * around_ : 0.0;
    for (std::size_t k = 0; k < goal.size(); ++k)
      goal[k] = std::min(std::max(goal[k] + (k < BASE ? base : joints) * random_.normal(), lower_[k]), upper_[k]);
    return goal;
  }

  // Extends a tree from its nearest node towards a configuration until a collision; returns the new node, if any.
  std::size_t grow(Tree & tree, const Row & goal)
  {
    const std::size_t near = tree.nearest(goal, measure_);
    if (tree.nodes[near] == goal)
      return near;
    const double reached = lines_->free(tree.nodes[near].data(), goal.data());
    return reached > 0.0 ? tree.add(between(tree.nodes[near], goal, reached), near) : NONE;
  }

  nb::object kept_; // owns the lines
  vkc_pin::StraightLines * lines_;
  Measure measure_;
  Row lower_, upper_;
  Rows poses_, arms_;
  std::vector<Rows> runs_;
  double beside_, around_;
  Random random_;
};

} // namespace

NB_MODULE(_trees, module)
{
  module.doc() = "Two random trees of configurations that grow towards each other, and what makes their paths shorter.";
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
