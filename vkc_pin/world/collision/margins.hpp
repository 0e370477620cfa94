// Margins of pairs: a default each, reduced between some waypoints and in some regions of the
// configuration space.
#pragma once

#include <algorithm>
#include <limits>
#include <stdexcept>
#include <vector>

#include "arrays.hpp"

namespace {

class Margins
{
public:
  explicit Margins(const Numbers<1> & defaults)
  : defaults_(defaults.data(), defaults.data() + defaults.shape(0)), change_indices_(defaults.shape(0), -1)
  {
  }

  // Reduces the margin of a pair between two waypoints.
  void relax(Index pair, Index first, Index last, double margin) { change(pair).spans.push_back({first, last, margin}); }

  // Reduces the margin of pairs in the region in which some coordinates are within limits.
  void add_region(
    const Indices<1> & pairs,
    double margin,
    const Indices<1> & columns,
    const Numbers<1> & lower,
    const Numbers<1> & upper)
  {
    if (lower.shape(0) != columns.shape(0) || upper.shape(0) != columns.shape(0))
      throw std::invalid_argument("as many limits as coordinates are needed");
    Region region{margin, {}};
    for (std::size_t k = 0; k < columns.shape(0); ++k)
    {
      if (columns(k) < 0)
        throw std::out_of_range("no such coordinate");
      region.limits.push_back({std::size_t(columns(k)), lower(k), upper(k)});
      coordinates_ = std::max(coordinates_, std::size_t(columns(k)) + 1);
    }
    for (std::size_t k = 0; k < pairs.shape(0); ++k)
      change(pairs(k)).regions.push_back(regions_.size());
    regions_.push_back(std::move(region));
  }

  // Margin of a pair at a waypoint and configuration; -inf: no check.
  double compute_margin(Index pair, Index waypoint, const double * z) const
  {
    double margin = defaults_[std::size_t(pair)];
    const Index number = change_indices_[std::size_t(pair)];
    if (number < 0)
      return margin;
    for (const auto & span : changes_[std::size_t(number)].spans)
      if (span.first <= waypoint && waypoint <= span.last)
        margin = std::min(margin, span.margin);
    for (const std::size_t region : changes_[std::size_t(number)].regions)
      if (regions_[region].contains(z))
        margin = std::min(margin, regions_[region].margin);
    return margin;
  }

  // Margins of many pairs; `rows` gives the row of z for each.
  Array<double> compute_margins(const Indices<1> & pairs, const Indices<1> & waypoints, const Numbers<2> & z, const Indices<1> & rows) const
  {
    if (waypoints.shape(0) != pairs.shape(0) || rows.shape(0) != pairs.shape(0) || z.shape(1) < coordinates_)
      throw std::invalid_argument("pairs, waypoints and rows are of shape (n,), coordinates of shape (W, m)");
    std::vector<double> found(pairs.shape(0));
    for (std::size_t k = 0; k < found.size(); ++k)
    {
      if (pairs(k) < 0 || pairs(k) >= Index(defaults_.size()) || rows(k) < 0 || rows(k) >= Index(z.shape(0)))
        throw std::out_of_range("no such pair or row");
      found[k] = compute_margin(pairs(k), waypoints(k), z.data() + rows(k) * z.shape(1));
    }
    const std::size_t count = found.size();
    return handed_over(std::move(found), {count});
  }

  std::size_t size() const { return defaults_.size(); }

  std::size_t coordinates() const { return coordinates_; } // minimum number of columns of z

private:
  struct Span
  {
    Index first, last;
    double margin;
  };

  struct Limits
  {
    std::size_t column;
    double lower, upper;
  };

  struct Region
  {
    double margin;
    std::vector<Limits> limits;

    bool contains(const double * z) const
    {
      return std::all_of(limits.begin(), limits.end(), [z](const Limits & limit) {
        return limit.lower <= z[limit.column] && z[limit.column] <= limit.upper;
      });
    }
  };

  struct Change
  {
    std::vector<Span> spans;
    std::vector<std::size_t> regions;
  };

  Change & change(Index pair)
  {
    if (pair < 0 || pair >= Index(defaults_.size()))
      throw std::out_of_range("no such pair");
    Index & number = change_indices_[std::size_t(pair)];
    if (number < 0)
    {
      number = Index(changes_.size());
      changes_.emplace_back();
    }
    return changes_[std::size_t(number)];
  }

  std::vector<double> defaults_;
  std::vector<Index> change_indices_; // for each pair, its index in changes_, or -1
  std::vector<Change> changes_;
  std::vector<Region> regions_;
  std::size_t coordinates_ = 0;
};

} // namespace
