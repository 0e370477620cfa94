// Computes the fastest speeds along a path by TOPP-RA (Pham and Pham, A new approach to time-optimal path parameterization based
// on reachability analysis, 2018). Why not the library toppra: docs/decisions/0036.
//
// The path acceleration u is constant between two grid points a distance l apart. The squares x and y of the path velocity there
// satisfy y - x = 2 l u, so that all limits are linear in x and y.

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include <nanobind/stl/optional.h>

#include "../../world/collision/arrays.hpp"

namespace
{

// Relative errors of squares that count as rounding.
constexpr double ROUNDING = 1e-9;
// By this the limits of the forward pass exceed those of the backward pass. It finds squares that the backward pass has proved to
// exist; rounding must not exclude them where a limit hardly depends on y. A larger value would let the path creep where its
// limits permit no motion.
constexpr double FORWARD_ROUNDING = 1e-12;

// Squares of the path velocity.
struct Range
{
  double low, high;

  bool empty() const { return low > high + ROUNDING * high; }
  bool contains(double square) const { return low - ROUNDING * high <= square && square <= high + ROUNDING * high; }
};

// The condition lower <= at_begin x + at_end y <= upper of an interval, with at_end >= 0.
struct Row
{
  double at_begin, at_end, lower, upper;
};

class Path
{
public:
  // `positions` of grid points and `max_squares` of the path velocity there, (K,). The limits are |a u + b x + c| <= 1, with the
  // coefficients at samples, (S, m) each. The samples `begins`, (K - 1,), are at the begins of intervals, the next ones at their
  // ends.
  Path(
    const Numbers<1> & positions,
    const Numbers<1> & max_squares,
    const Indices<1> & begins,
    const Numbers<2> & a,
    const Numbers<2> & b,
    const Numbers<2> & c)
  : positions_(positions), max_squares_(max_squares), begins_(begins), a_(a), b_(b), c_(c)
  {
    const std::size_t points = positions.shape(0);
    if (points < 2 || max_squares.shape(0) != points || begins.shape(0) != points - 1)
      throw std::invalid_argument("positions, squares and intervals do not belong together");
    for (const auto & other : {b, c})
      if (other.shape(0) != a.shape(0) || other.shape(1) != a.shape(1))
        throw std::invalid_argument("coefficients have different shapes");
    for (std::size_t i = 0; i + 1 < points; ++i)
      if (begins(i) < 0 || std::size_t(begins(i)) + 1 >= a.shape(0))
        throw std::invalid_argument("an interval has no samples");
  }

  // Returns the squares of the fastest path velocities, given the first and the last one; empty if there are none.
  std::vector<double> fastest_squares(double first, double last) const
  {
    const std::size_t points = positions_.shape(0);
    std::vector<Range> controllable(points); // squares from which the end can be reached
    std::vector<Row> rows;
    controllable.back() = {0.0, max_squares_(points - 1)};
    if (!controllable.back().contains(last))
      return {};
    controllable.back() = {last, last};
    for (std::size_t i = points - 1; i-- > 0;)
    {
      collect_rows(i, 1.0, rows);
      controllable[i] = eliminate_end(rows, {0.0, max_squares_(i)}, controllable[i + 1]);
      if (controllable[i].empty())
        return {};
    }
    if (!controllable.front().contains(first))
      return {};
    std::vector<double> squares{first};
    for (std::size_t i = 0; i + 1 < points; ++i)
    {
      collect_rows(i, 1.0 + FORWARD_ROUNDING, rows);
      squares.push_back(find_largest_end(rows, squares.back(), controllable[i + 1]));
    }
    return squares;
  }

private:
  // Collects the conditions |a u + b x + c| <= bound at both ends of an interval, multiplied by twice its length.
  void collect_rows(std::size_t interval, double bound, std::vector<Row> & rows) const
  {
    const double twice = 2.0 * (positions_(interval + 1) - positions_(interval));
    const auto add = [&](double at_begin, double at_end, double constant) {
      if (at_end >= 0.0)
        rows.push_back({at_begin, at_end, -twice * bound - constant, twice * bound - constant});
      else
        rows.push_back({-at_begin, -at_end, constant - twice * bound, constant + twice * bound});
    };
    const std::size_t begin = std::size_t(begins_(interval)), end = begin + 1;
    rows.clear();
    for (std::size_t k = 0; k < a_.shape(1); ++k)
    {
      add(twice * b_(begin, k) - a_(begin, k), a_(begin, k), twice * c_(begin, k));
      add(-a_(end, k), twice * b_(end, k) + a_(end, k), twice * c_(end, k));
    }
  }

  // Returns those of the squares x for which some y satisfies all rows: y is eliminated from each pair of rows (Fourier and
  // Motzkin). Products of rows with each other's coefficients avoid quotients by coefficients of y, which may be tiny.
  static Range eliminate_end(std::vector<Row> & rows, Range x, const Range & y)
  {
    const auto is_redundant = [&](const Row & row) {
      const double least = row.at_begin * (row.at_begin < 0.0 ? x.high : x.low) + row.at_end * y.low;
      const double most = row.at_begin * (row.at_begin < 0.0 ? x.low : x.high) + row.at_end * y.high;
      return least >= row.lower && most <= row.upper;
    };
    rows.erase(std::remove_if(rows.begin(), rows.end(), is_redundant), rows.end());
    rows.push_back({0.0, 1.0, y.low, y.high});
    for (auto row = rows.begin(); row != rows.end(); ++row)
      for (auto other = rows.begin(); other != row; ++other)
      {
        double slope = other->at_end * row->at_begin - row->at_end * other->at_begin;
        double lower = other->at_end * row->lower - row->at_end * other->upper;
        double upper = other->at_end * row->upper - row->at_end * other->lower;
        if (slope < 0.0)
        {
          slope = -slope;
          std::swap(lower, upper);
          lower = -lower;
          upper = -upper;
        }
        if (slope * x.high > upper)
          x.high = upper / slope;
        if (slope * x.low < lower)
          x.low = lower / slope;
      }
    return x;
  }

  // Returns the largest y in a range that satisfies all rows.
  static double find_largest_end(const std::vector<Row> & rows, double x, const Range & y)
  {
    double largest = y.high;
    for (const Row & row : rows)
    {
      const double upper = row.upper - row.at_begin * x;
      if (row.at_end > 0.0 && row.at_end * largest > upper)
        largest = upper / row.at_end;
    }
    return std::max(largest, y.low);
  }

  Numbers<1> positions_, max_squares_;
  Indices<1> begins_;
  Numbers<2> a_, b_, c_;
};

// Returns `Path::fastest_squares`, or nothing if there are none.
std::optional<Array<double>> fastest_squares(
  const Numbers<1> & positions,
  const Numbers<1> & max_squares,
  const Indices<1> & begins,
  const Numbers<2> & a,
  const Numbers<2> & b,
  const Numbers<2> & c,
  double first,
  double last)
{
  const Path path(positions, max_squares, begins, a, b, c);
  std::vector<double> squares;
  {
    nb::gil_scoped_release released;
    squares = path.fastest_squares(first, last);
  }
  if (squares.empty())
    return std::nullopt;
  const std::size_t count = squares.size();
  return handed_over(std::move(squares), {count});
}

} // namespace

NB_MODULE(_speeds, module)
{
  module.doc() = "The fastest speeds along paths.";
  nb::set_leak_warnings(false); // caches and globals live until the process ends
  module.def("fastest_squares", &fastest_squares);
}
