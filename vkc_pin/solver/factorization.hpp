// LDLᵀ of a sparse symmetric matrix, in an order that is made for the systems of an interior-point method on a trajectory.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

// Factors P·A·Pᵀ = L·D·Lᵀ with a diagonal D, row by row (up-looking: Davis, "User Guide for LDL", 2005; Stewart, "Building an
// Old-Fashioned Sparse Solver", 2003).
//
// A system of an interior-point method has primal rows, whose diagonals are positive at first, and dual ones, whose diagonals
// are zero. Pivots are taken as they come, so the order has to see to it that none is zero (Bridson, "An Ordering Method for
// the Direct Solution of Saddle-Point Matrices", 2007):
//   1. primal rows that only one dual one knows, such as slacks: they cost nothing;
//   2. dual rows that know one of these, each of which has a pivot now; for the rest that is as if it were not there, but for
//      what it adds to the Hessian;
//   3. other primal rows in the order of the program, which is that of time: what is coupled lies close together, and what is
//      filled in is a band;
//   4. each other dual row after the last primal one that it knows.
class Factorization
{
public:
  // Takes the lower triangle, column by column: rows[columns[j] - base] and on are those of column j, counted from base.
  Factorization(std::size_t size, const int * columns, const int * rows, int base)
  : size_(size)
  , columns_(columns, columns + size + 1)
  , rows_(rows, rows + (columns[size] - base))
  {
    for (int & entry : columns_)
      entry -= base;
    for (int & row : rows_)
      row -= base;
  }

  std::size_t size() const { return size_; }
  std::size_t entries() const { return rows_.size(); }
  // Number of negative pivots: by Sylvester's law, of negative eigenvalues.
  int negative() const { return negative_; }
  // Number of entries below the diagonal of L.
  std::size_t filled() const { return entries_.size(); }
  // Whether the last call of `factor` worked, so that there is something to solve with.
  bool factored() const { return factored_; }

  // Factors the matrix with these entries; returns whether that worked, which it does not if it is singular. The first time, the
  // diagonal decides which rows are dual.
  bool factor(const double * values)
  {
    factored_ = false;
    if (order_.empty())
    {
      order(values);
      analyse();
    }
    constexpr double least = 8.0 * std::numeric_limits<double>::epsilon();
    negative_ = 0;
    std::fill(ends_.begin(), ends_.end(), 0);
    std::fill(seen_.begin(), seen_.end(), -1);
    for (int k = 0; k < int(size_); ++k)
    {
      const int first = reach(k, values);
      double pivot = work_[k], size = std::abs(pivot);
      work_[k] = 0.0;
      for (int at = first; at < int(size_); ++at)
      {
        const int i = reached_[at];
        const double value = work_[i], share = value / pivots_[i];
        work_[i] = 0.0;
        const int end = begins_[i] + ends_[i]++;
        for (int p = begins_[i]; p < end; ++p)
          work_[places_[p]] -= entries_[p] * value;
        pivot -= share * value;
        size += std::abs(share * value);
        places_[end] = k;
        entries_[end] = share;
      }
      if (!(std::abs(pivot) > least * size))
      {
        std::fill(work_.begin(), work_.end(), 0.0);
        return false;
      }
      pivots_[k] = pivot;
      negative_ += pivot < 0.0;
    }
    return factored_ = true;
  }

  // Replaces b by the solution of A·x = b.
  void solve(double * x)
  {
    const int size = int(size_);
    for (int k = 0; k < size; ++k)
      work_[k] = x[order_[k]];
    for (int k = 0; k < size; ++k)
      for (int p = begins_[k]; p < begins_[k + 1]; ++p)
        work_[places_[p]] -= entries_[p] * work_[k];
    for (int k = size - 1; k >= 0; --k)
    {
      double sum = work_[k] / pivots_[k];
      for (int p = begins_[k]; p < begins_[k + 1]; ++p)
        sum -= entries_[p] * work_[places_[p]];
      work_[k] = sum;
    }
    for (int k = 0; k < size; ++k)
      x[order_[k]] = work_[k];
    std::fill(work_.begin(), work_.end(), 0.0);
  }

private:
  // Finds the order of elimination.
  void order(const double * values)
  {
    const int size = int(size_);
    std::vector<char> dual(size_, true);
    std::vector<int> degree(size_, 0), primal(size_, 0); // how many rows know each, and how many primal ones
    for (int j = 0; j < size; ++j)
      for (int p = columns_[j]; p < columns_[j + 1]; ++p)
        if (rows_[p] == j && values[p] > 0.0)
          dual[j] = false;
    each_pair([&](int i, int j) {
      ++degree[i];
      primal[i] += !dual[j];
    });
    std::vector<char> slack(size_), slackened(size_, false);
    for (int j = 0; j < size; ++j)
      slack[j] = !dual[j] && degree[j] <= 1 && primal[j] == 0;
    std::vector<int> last(size_, -1); // the last primal row that knows a dual one
    each_pair([&](int i, int j) {
      if (dual[i] && slack[j])
        slackened[i] = true;
      else if (dual[i] && !dual[j])
        last[i] = std::max(last[i], j);
    });
    // What comes before all others, then what comes with each row of the program, then what nothing primal knows.
    enum { SLACK = -2, SLACKENED = -1 };
    std::vector<std::pair<int, int>> when;
    for (int j = 0; j < size; ++j)
    {
      int turn = 2 * j;
      if (slack[j])
        turn = SLACK;
      else if (slackened[j])
        turn = SLACKENED;
      else if (dual[j])
        turn = last[j] < 0 ? 2 * size : 2 * last[j] + 1;
      when.emplace_back(turn, j);
    }
    std::sort(when.begin(), when.end());
    for (const auto & [turn, j] : when)
      order_.push_back(j);
  }

  // Calls f(i, j) and f(j, i) for every entry off the diagonal.
  template<typename Function>
  void each_pair(const Function & f) const
  {
    for (int j = 0; j < int(size_); ++j)
      for (int p = columns_[j]; p < columns_[j + 1]; ++p)
        if (rows_[p] != j)
        {
          f(rows_[p], j);
          f(j, rows_[p]);
        }
  }

  // Finds where L has entries.
  void analyse()
  {
    const int size = int(size_);
    std::vector<int> place(size_);
    for (int k = 0; k < size; ++k)
      place[order_[k]] = k;
    above_.assign(size_ + 1, 0);
    const auto each = [&](const auto & f) {
      for (int j = 0; j < size; ++j)
        for (int p = columns_[j]; p < columns_[j + 1]; ++p)
          f(std::minmax(place[j], place[rows_[p]]), p);
    };
    each([&](auto ends, int) { ++above_[ends.second + 1]; });
    for (int k = 0; k < size; ++k)
      above_[k + 1] += above_[k];
    std::vector<int> next(above_.begin(), above_.end() - 1);
    above_rows_.resize(rows_.size());
    values_.resize(rows_.size());
    each([&](auto ends, int p) {
      const int at = next[ends.second]++;
      above_rows_[at] = ends.first;
      values_[at] = p;
    });
    // The elimination tree, and how many entries each column of L has.
    parents_.assign(size_, -1);
    seen_.assign(size_, -1);
    ends_.assign(size_, 0);
    for (int k = 0; k < size; ++k)
    {
      seen_[k] = k;
      for (int p = above_[k]; p < above_[k + 1]; ++p)
        for (int i = above_rows_[p]; seen_[i] != k; i = parents_[i])
        {
          if (parents_[i] < 0)
            parents_[i] = k;
          ++ends_[i];
          seen_[i] = k;
        }
    }
    begins_.assign(size_ + 1, 0);
    for (int k = 0; k < size; ++k)
      begins_[k + 1] = begins_[k] + ends_[k];
    places_.resize(begins_[size]);
    entries_.resize(begins_[size]);
    pivots_.resize(size_);
    work_.assign(size_, 0.0);
    reached_.resize(size_);
  }

  // Puts row k of the matrix, up to its diagonal, where work is done; returns from where on `reached_` has the columns of L in
  // which that row has entries, each after those that it waits for.
  int reach(int k, const double * values)
  {
    int first = int(size_);
    seen_[k] = k;
    for (int p = above_[k]; p < above_[k + 1]; ++p)
    {
      int i = above_rows_[p], length = 0;
      work_[i] += values[values_[p]];
      for (; seen_[i] != k; i = parents_[i])
      {
        reached_[length++] = i;
        seen_[i] = k;
      }
      while (length > 0)
        reached_[--first] = reached_[--length];
    }
    return first;
  }

  std::size_t size_;
  std::vector<int> columns_, rows_;              // the lower triangle
  std::vector<int> order_;                       // which row is eliminated when
  std::vector<int> above_, above_rows_, values_; // the upper triangle in that order, and where its values are
  std::vector<int> parents_, seen_, reached_;    // the elimination tree
  std::vector<int> begins_, ends_, places_;      // of columns of L; how many entries each has by now; their rows
  std::vector<double> entries_, pivots_, work_;
  int negative_ = 0;
  bool factored_ = false;
};
