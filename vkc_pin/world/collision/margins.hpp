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
  explicit Margins(const Numbers<1> & usual) : usual_(usual.data(), usual.data() + usual.shape(0)), changes_(usual.shape(0), -1) {}

  // Reduces the margin of a pair between two waypoints.
  void ease(Index pair, Index first, Index last, double margin) { change(pair).spans.push_back({first, last, margin}); }

  // Reduces the margin of pairs in the region in which some coordinates are within limits.
  void near(
    const Indices<1> & pairs,
    double margin,
    const Indices<1> & columns,
    const Numbers<1> & lower,
    const Numbers<1> & upper)
  {
    if (lower.shape(0) != columns.shape(0) || upper.shape(0) != columns.shape(0))
      throw std::invalid_argument("as many limits as coordinates are needed");
    Place place{margin, {}};
    for (std::size_t k = 0; k < columns.shape(0); ++k)
    {
      if (columns(k) < 0)
        throw std::out_of_range("no such coordinate");
      place.within.push_back({std::size_t(columns(k)), lower(k), upper(k)});
      coordinates_ = std::max(coordinates_, std::size_t(columns(k)) + 1);
    }
    for (std::size_t k = 0; k < pairs.shape(0); ++k)
      change(pairs(k)).places.push_back(places_.size());
    places_.push_back(std::move(place));
  }

  // Margin of a pair at a waypoint and configuration; -inf: no check.
  double at(Index pair, Index waypoint, const double * z) const
  {
    double margin = usual_[std::size_t(pair)];
    const Index number = changes_[std::size_t(pair)];
    if (number < 0)
      return margin;
    for (const auto & span : changed_[std::size_t(number)].spans)
      if (span.first <= waypoint && waypoint <= span.last)
        margin = std::min(margin, span.margin);
    for (const std::size_t place : changed_[std::size_t(number)].places)
      if (places_[place].holds(z))
        margin = std::min(margin, places_[place].margin);
    return margin;
  }

  // Margins of many pairs; `rows` gives the row of z for each.
  Array<double> at_all(const Indices<1> & pairs, const Indices<1> & waypoints, const Numbers<2> & z, const Indices<1> & rows) const
  {
    if (waypoints.shape(0) != pairs.shape(0) || rows.shape(0) != pairs.shape(0) || z.shape(1) < coordinates_)
      throw std::invalid_argument("pairs, waypoints and rows are of shape (n,), coordinates of shape (W, m)");
    std::vector<double> found(pairs.shape(0));
    for (std::size_t k = 0; k < found.size(); ++k)
    {
      if (pairs(k) < 0 || pairs(k) >= Index(usual_.size()) || rows(k) < 0 || rows(k) >= Index(z.shape(0)))
        throw std::out_of_range("no such pair or row");
      found[k] = at(pairs(k), waypoints(k), z.data() + rows(k) * z.shape(1));
    }
    const std::size_t count = found.size();
    return handed_over(std::move(found), {count});
  }

  std::size_t size() const { return usual_.size(); }

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

  struct Place
  {
    double margin;
    std::vector<Limits> within;

    bool holds(const double * z) const
    {
      return std::all_of(within.begin(), within.end(), [z](const Limits & limits) {
        return limits.lower <= z[limits.column] && z[limits.column] <= limits.upper;
      });
    }
  };

  struct Change
  {
    std::vector<Span> spans;
    std::vector<std::size_t> places;
  };

  Change & change(Index pair)
  {
    if (pair < 0 || pair >= Index(usual_.size()))
      throw std::out_of_range("no such pair");
    Index & number = changes_[std::size_t(pair)];
    if (number < 0)
    {
      number = Index(changed_.size());
      changed_.emplace_back();
    }
    return changed_[std::size_t(number)];
  }

  std::vector<double> usual_;
  std::vector<Index> changes_; // for each pair, its index in changed_, or -1
  std::vector<Change> changed_;
  std::vector<Place> places_;
  std::size_t coordinates_ = 0;
};

} // namespace
