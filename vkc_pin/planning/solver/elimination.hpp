// In which order the rows of a sparse symmetric matrix are eliminated: those of an interior-point method on a trajectory.
#pragma once

#include <algorithm>
#include <cstddef>
#include <utility>
#include <vector>

using Entries = std::vector<std::pair<int, int>>; // where a matrix has any, each above or below the diagonal

// Calls f(i, j) and f(j, i) for every entry off the diagonal.
template<typename Function>
void each_pair(const Entries & entries, const Function & f)
{
  for (const auto & [i, j] : entries)
    if (i != j)
    {
      f(i, j);
      f(j, i);
    }
}

struct Order
{
  std::vector<int> rows;
  int alone = 0; // how many of them, the first ones, know none of those next to them: slacks, and dual rows that know one
};

// A system of an interior-point method has primal rows, whose diagonals are positive at first, and dual ones, whose diagonals
// are zero. Pivots are taken as they come, so the order has to see to it that none is zero (Bridson, "An Ordering Method for
// the Direct Solution of Saddle-Point Matrices", 2007):
//   1. primal rows that only one dual one knows, such as slacks: they cost nothing;
//   2. dual rows that know one of these, each of which has a pivot now; for the rest that is as if it were not there, but for
//      what it adds to the Hessian;
//   3. other primal rows in the order of the program, which is that of time: what is coupled lies close together, and what is
//      filled in is a band;
//   4. each other dual row after the last primal one that it knows.
inline Order elimination_order(int size, const Entries & entries, const double * values)
{
  std::vector<double> diagonal(size, 0.0);
  for (std::size_t p = 0; p < entries.size(); ++p)
    if (entries[p].first == entries[p].second)
      diagonal[entries[p].first] += values[p];
  std::vector<char> dual(size);
  for (int j = 0; j < size; ++j)
    dual[j] = !(diagonal[j] > 0.0);
  std::vector<int> degree(size, 0), primal(size, 0); // how many rows know each, and how many primal ones
  each_pair(entries, [&](int i, int j) {
    ++degree[i];
    primal[i] += !dual[j];
  });
  std::vector<char> slack(size), slackened(size, false);
  for (int j = 0; j < size; ++j)
    slack[j] = !dual[j] && degree[j] <= 1 && primal[j] == 0;
  std::vector<int> last(size, -1); // the last primal row that knows a dual one
  each_pair(entries, [&](int i, int j) {
    if (dual[i] && slack[j])
      slackened[i] = true;
    else if (dual[i] && !dual[j])
      last[i] = std::max(last[i], j);
  });
  // What comes before all others, then what comes with each row of the program, then what nothing primal knows.
  enum { SLACK = -2, SLACKENED = -1 };
  std::vector<std::pair<int, int>> when;
  Order found;
  for (int j = 0; j < size; ++j)
  {
    int turn = 2 * j;
    if (slack[j])
      turn = SLACK;
    else if (slackened[j])
      turn = SLACKENED;
    else if (dual[j])
      turn = last[j] < 0 ? 2 * size : 2 * last[j] + 1;
    found.alone += turn < 0;
    when.emplace_back(turn, j);
  }
  std::sort(when.begin(), when.end());
  for (const auto & [turn, j] : when)
    found.rows.push_back(j);
  return found;
}
