#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "elimination.hpp"

// Factors P·A·Pᵀ = L·D·Lᵀ with a diagonal D, by panels of a few neighbouring columns. A panel of L
// is dense, has only the rows in which one of its columns has an entry, and updates the columns to
// its right when it is done (right-looking supernodes: Ng and Peyton, "Block Sparse Cholesky
// Algorithms on Advanced Uniprocessor Computers", 1993).
class Factorization
{
public:
  // Takes positions of entries, each above or below the diagonal, counted from 1; duplicates are
  // summed.
  Factorization(int size, int entries, const int * rows, const int * columns) : size_(size)
  {
    for (int p = 0; p < entries; ++p)
      entries_.emplace_back(rows[p] - 1, columns[p] - 1);
  }

  // Number of negative pivots, by Sylvester's law that of negative eigenvalues.
  int negative() const { return negative_; }
  // Whether the last call of `factor` succeeded.
  bool factored() const { return factored_; }

  // Factors the matrix with these entries; returns false if it is singular. The first call decides
  // by the diagonal which rows are dual.
  bool factor(const double * values)
  {
    factored_ = false;
    if (order_.rows.empty())
      analyse(values);
    negative_ = 0;
    std::fill(values_.begin(), values_.end(), 0.0);
    std::fill(sums_.begin(), sums_.end(), 0.0);
    for (std::size_t p = 0; p < places_.size(); ++p)
      values_[places_[p]] += values[p];
    for (const Panel & panel : panels_)
    {
      if (!eliminate(panel))
        return false;
      update(panel);
    }
    return factored_ = true;
  }

  // Solves A·x = b in place.
  void solve(double * x)
  {
    for (int k = 0; k < size_; ++k)
      work_[k] = x[order_.rows[k]];
    for (const Panel & panel : panels_)
    {
      const int * rows = &panel_rows_[panel.rows];
      for (int k = 0; k < panel.width; ++k)
      {
        const double * column = &values_[panel.values + k * panel.height];
        const double value = work_[panel.first + k];
        for (int i = k + 1; i < panel.width; ++i)
          work_[panel.first + i] -= column[i] * value;
        for (int i = panel.width; i < panel.height; ++i)
          work_[rows[i]] -= column[i] * value;
      }
    }
    for (auto panel = panels_.rbegin(); panel != panels_.rend(); ++panel)
    {
      const int * rows = &panel_rows_[panel->rows];
      for (int k = panel->width - 1; k >= 0; --k)
      {
        const double * column = &values_[panel->values + k * panel->height];
        double sum = work_[panel->first + k] / column[k];
        for (int i = k + 1; i < panel->width; ++i)
          sum -= column[i] * work_[panel->first + i];
        for (int i = panel->width; i < panel->height; ++i)
          sum -= column[i] * work_[rows[i]];
        work_[panel->first + k] = sum;
      }
    }
    for (int k = 0; k < size_; ++k)
      x[order_.rows[k]] = work_[k];
  }

private:
  static constexpr int WIDTH = 8; // maximum number of columns of a panel

  // Columns of L: `width` from `first` on, with `height` entries each, the panel's own rows first;
  // offsets of their rows, values and updates.
  struct Panel
  {
    int first, width, height;
    std::size_t rows, values, updates, last_update;
  };

  // Update of another panel: rows `begin` to `end` of this panel are columns of the other; their
  // positions there, and those of later rows, are in `updated_` from `places` on.
  struct Update
  {
    int panel, begin, end;
    std::size_t places;
  };

  // Determines the panels, the positions of the matrix' entries in them, and the updates between them.
  void analyse(const double * values)
  {
    order_ = elimination_order(size_, entries_, values);
    std::vector<int> when(size_), panel_of(size_), at(size_ + 1, 0), below(entries_.size());
    for (int k = 0; k < size_; ++k)
      when[order_.rows[k]] = k;
    const auto each = [&](const auto & f) {
      for (std::size_t p = 0; p < entries_.size(); ++p)
      {
        const auto [first, last] = std::minmax(when[entries_[p].first], when[entries_[p].second]);
        f(first, last, p);
      }
    };
    each([&](int column, int, std::size_t) { ++at[column + 1]; });
    for (int k = 0; k < size_; ++k)
      at[k + 1] += at[k];
    std::vector<int> next(at.begin(), at.end() - 1);
    each([&](int column, int row, std::size_t) { below[next[column]++] = row; });
    // Rows of a panel: those of its entries, and those of panels whose first later row is one of its columns.
    std::vector<int> seen(size_, -1);
    std::vector<std::vector<int>> children;
    for (int first = 0; first < size_;)
    {
      const int number = int(panels_.size()), width = first < order_.alone ? 1 : std::min(WIDTH, size_ - first);
      for (int k = first; k < first + width; ++k)
        panel_of[k] = number;
      panels_.push_back({first, width, 0, 0, 0, 0, 0});
      first += width;
    }
    children.resize(panels_.size());
    for (std::size_t number = 0; number < panels_.size(); ++number)
    {
      Panel & panel = panels_[number];
      const int end = panel.first + panel.width;
      panel.rows = panel_rows_.size();
      for (int k = panel.first; k < end; ++k)
        panel_rows_.push_back(k);
      const auto add = [&](int row) {
        if (row >= end && seen[row] != int(number))
        {
          seen[row] = int(number);
          panel_rows_.push_back(row);
        }
      };
      std::for_each(below.begin() + at[panel.first], below.begin() + at[end], add);
      for (const int child : children[number])
        for (int i = panels_[child].width; i < panels_[child].height; ++i)
          add(panel_rows_[panels_[child].rows + i]);
      std::sort(panel_rows_.begin() + std::ptrdiff_t(panel.rows), panel_rows_.end());
      panel.height = int(panel_rows_.size() - panel.rows);
      if (panel.height > panel.width)
        children[panel_of[panel_rows_[panel.rows + panel.width]]].push_back(int(number));
      panel.values = values_.size();
      values_.resize(values_.size() + std::size_t(panel.width) * panel.height);
    }
    for (Panel & panel : panels_)
      plan_updates(panel, panel_of);
    places_.resize(entries_.size());
    each([&](int column, int row, std::size_t p) {
      const Panel & panel = panels_[panel_of[column]];
      places_[p] = panel.values + std::size_t(column - panel.first) * panel.height + place(panel, row);
    });
    sums_.resize(size_);
    work_.resize(size_);
  }

  // Returns the position of a row in a panel.
  int place(const Panel & panel, int row) const
  {
    const auto begin = panel_rows_.begin() + std::ptrdiff_t(panel.rows);
    return int(std::lower_bound(begin, begin + panel.height, row) - begin);
  }

  void plan_updates(Panel & panel, const std::vector<int> & panel_of)
  {
    panel.updates = updates_.size();
    const int * rows = &panel_rows_[panel.rows];
    for (int begin = panel.width; begin < panel.height;)
    {
      const int number = panel_of[rows[begin]];
      int end = begin;
      while (end < panel.height && panel_of[rows[end]] == number)
        ++end;
      updates_.push_back({number, begin, end, updated_.size()});
      for (int i = begin; i < panel.height; ++i)
        updated_.push_back(place(panels_[number], rows[i]));
      begin = end;
    }
    panel.last_update = updates_.size();
  }

  // Factors the columns of a panel; returns false if a pivot is zero up to rounding.
  bool eliminate(const Panel & panel)
  {
    constexpr double least = 8.0 * std::numeric_limits<double>::epsilon();
    const int height = panel.height;
    for (int k = 0; k < panel.width; ++k)
    {
      double * column = &values_[panel.values + std::size_t(k) * height];
      const double pivot = column[k];
      if (!(std::abs(pivot) > least * sums_[panel.first + k]))
        return false;
      negative_ += pivot < 0.0;
      for (int j = k + 1; j < panel.width; ++j)
      {
        double * other = &values_[panel.values + std::size_t(j) * height];
        const double share = column[j] / pivot;
        sums_[panel.first + j] += std::abs(share * column[j]);
        for (int i = j; i < height; ++i)
          other[i] -= share * column[i];
      }
      const double inverse = 1.0 / pivot;
      for (int i = k + 1; i < height; ++i)
        column[i] *= inverse;
    }
    return true;
  }

  // Subtracts the contributions of a panel from the columns to its right.
  void update(const Panel & panel)
  {
    const int height = panel.height, width = panel.width;
    const double * values = &values_[panel.values];
    const int * rows = &panel_rows_[panel.rows];
    double products[WIDTH];
    for (std::size_t u = panel.updates; u < panel.last_update; ++u)
    {
      const Update & update = updates_[u];
      const Panel & other = panels_[update.panel];
      const int * places = &updated_[update.places] - update.begin;
      for (int j = update.begin; j < update.end; ++j)
      {
        double sum = 0.0;
        for (int k = 0; k < width; ++k)
        {
          const double entry = values[std::size_t(k) * height + j];
          products[k] = entry * values[std::size_t(k) * height + k];
          sum += std::abs(products[k] * entry);
        }
        sums_[rows[j]] += sum;
        double * target = &values_[other.values + std::size_t(places[j]) * other.height];
        subtract(values, height, width, products, j, places, target);
      }
    }
  }

  // Subtracts L·products, from row j on, from a column.
  void subtract(
    const double * values, int height, int width, const double * products, int j, const int * places, double * target)
  {
    if (width == 1) // most panels are slacks or their dual rows: saves a sixth of the time
    {
      for (int i = j; i < height; ++i)
        target[places[i]] -= values[i] * products[0];
      return;
    }
    if (int(sum_.size()) < height)
      sum_.resize(height);
    double * sum = sum_.data();
    std::fill(sum + j, sum + height, 0.0);
    int k = 0;
    for (; k + 4 <= width; k += 4)
    {
      const double *a = values + std::size_t(k) * height, *b = a + height, *c = b + height, *d = c + height;
      const double p = products[k], q = products[k + 1], r = products[k + 2], s = products[k + 3];
      for (int i = j; i < height; ++i)
        sum[i] += (a[i] * p + b[i] * q) + (c[i] * r + d[i] * s);
    }
    for (; k < width; ++k)
    {
      const double * a = values + std::size_t(k) * height;
      for (int i = j; i < height; ++i)
        sum[i] += a[i] * products[k];
    }
    for (int i = j; i < height; ++i)
      target[places[i]] -= sum[i];
  }

  int size_;
  Entries entries_;
  Order order_;
  std::vector<Panel> panels_;
  std::vector<int> panel_rows_, updated_;
  std::vector<Update> updates_;
  std::vector<std::size_t> places_; // positions of the matrix' entries in the panels
  std::vector<double> values_;      // of the panels: L below the diagonal, D on it
  std::vector<double> sums_;        // sums of absolute values subtracted from each pivot
  std::vector<double> work_, sum_;
  int negative_ = 0;
  bool factored_ = false;
};
