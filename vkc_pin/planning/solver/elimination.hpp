// Elimination order for the sparse symmetric systems of an interior-point method on a trajectory.
#pragma once

#include <algorithm>
#include <cstddef>
#include <utility>
#include <vector>

using Entries = std::vector<std::pair<int, int>>; // positions of entries, each above or below the diagonal

// Calls f(i, j) and f(j, i) for every off-diagonal entry.
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
  int alone = 0; // number of leading rows without coupling among them: slacks, and dual rows with one
};

// Primal rows of an interior-point method have diagonals that are positive at first, dual rows zero
// diagonals. There is no pivoting, so the order must avoid zero pivots (Bridson, "An Ordering Method
// for the Direct Solution of Saddle-Point Matrices", 2007):
//   1. primal rows coupled with a single dual row, such as slacks: they cause no fill-in;
//   2. dual rows coupled with one of these, which now have a pivot;
//   3. other primal rows in the order of the program, which is that of time: the fill-in is a band;
//   4. each other dual row after the last primal row that it is coupled with.
inline Order elimination_order(int size, const Entries & entries, const double * values)
{
  std::vector<double> diagonal(size, 0.0);
  for (std::size_t p = 0; p < entries.size(); ++p)
    if (entries[p].first == entries[p].second)
      diagonal[entries[p].first] += values[p];
  std::vector<char> dual(size);
  for (int j = 0; j < size; ++j)
    dual[j] = !(diagonal[j] > 0.0);
  std::vector<int> degree(size, 0), primal(size, 0); // numbers of coupled rows, and of primal ones among them
  each_pair(entries, [&](int i, int j) {
    ++degree[i];
    primal[i] += !dual[j];
  });
  std::vector<char> slack(size), slackened(size, false);
  for (int j = 0; j < size; ++j)
    slack[j] = !dual[j] && degree[j] <= 1 && primal[j] == 0;
  std::vector<int> last(size, -1); // last primal row coupled with a dual one
  each_pair(entries, [&](int i, int j) {
    if (dual[i] && slack[j])
      slackened[i] = true;
    else if (dual[i] && !dual[j])
      last[i] = std::max(last[i], j);
  });
  // Groups: slacks and their dual rows first, then the rows of the program, then rows without primal coupling.
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
