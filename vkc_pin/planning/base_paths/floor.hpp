// Lower bounds of the driving distance from places to every cell, turning being free.
#pragma once

#include <array>

#include "lattice.hpp"

class Floor
{
public:
  // `stuck`: certainly blocked nodes, (cells, cells, 16); `moves` in cells, (16, 2); `lengths` [m], (16,).
  Floor(
    const nb::ndarray<const std::uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu> & stuck,
    const Indices<2> & moves,
    const Numbers<1> & lengths)
  : cells_(Index(stuck.shape(0))), lattice_(cells_, moves), leads_(lattice_.size(), 0)
  {
    if (Index(stuck.shape(1)) != cells_ || stuck.shape(2) != HEADINGS)
      throw std::invalid_argument("nodes are of shape (cells, cells, 16)");
    if (lengths.shape(0) != HEADINGS)
      throw std::invalid_argument("lengths are of shape (16,)");
    if (!std::all_of(lengths.data(), lengths.data() + HEADINGS, [](double length) { return length > 0.0; }))
      throw std::invalid_argument("moves lead somewhere");
    std::vector<std::uint16_t> open(leads_.size(), 0); // headings at which a cell may be free
    for (Index i = 0; i < cells_; ++i)
      for (Index j = 0; j < cells_; ++j)
        for (Index heading = 0; heading < HEADINGS; ++heading)
          if (!stuck(i, j, heading))
            open[std::size_t(inner(i * cells_ + j))] |= std::uint16_t(1u << heading);
    for (Index heading = 0; heading < HEADINGS; ++heading)
    {
      lengths_[std::size_t(heading)] = lengths(heading);
      moves_[std::size_t(heading)] = (lattice_.target(heading, AHEAD) - heading) / HEADINGS;
    }
    for (Index cell = 0; cell < cells_ * cells_; ++cell)
      for (Index heading = 0; heading < HEADINGS; ++heading)
      {
        // Forwards at the heading or backwards at the opposite one.
        const Index here = inner(cell), there = here + moves_[std::size_t(heading)];
        const unsigned both = open[std::size_t(here)] & open[std::size_t(there)];
        if (both >> heading & 1u || both >> (heading + HEADINGS / 2) % HEADINGS & 1u)
          leads_[std::size_t(here)] |= std::uint16_t(1u << heading);
      }
  }

  // From W places, the k-th with the cells firsts[k]..firsts[k + 1] and their costs: distances [m], (W, cells, cells).
  Array<double> distances(
    const Indices<1> & firsts, const Indices<1> & begins, const Numbers<1> & costs, std::size_t threads) const
  {
    const std::size_t places = firsts.shape(0) - 1, count = std::size_t(cells_ * cells_);
    if (firsts.shape(0) < 1 || begins.shape(0) != costs.shape(0) || std::size_t(firsts(places)) != begins.shape(0))
      throw std::invalid_argument("cells and costs do not belong together");
    std::vector<double> found(places * count);
    {
      nb::gil_scoped_release released;
      const double shortest = *std::min_element(lengths_.begin(), lengths_.end());
      const double longest = *std::max_element(lengths_.begin(), lengths_.end());
      in_parts(places, threads, [&](std::size_t, std::size_t begin, std::size_t end) {
        std::vector<double> least(leads_.size());
        for (std::size_t k = begin; k < end; ++k)
        {
          std::fill(least.begin(), least.end(), std::numeric_limits<double>::infinity());
          std::vector<std::pair<double, Index>> first;
          for (Index entry = firsts(k); entry < firsts(k + 1); ++entry)
            first.emplace_back(costs(entry), inner(begins(entry)));
          spread(least, std::move(first), shortest, longest, [&](Index cell, double cost, const auto & reach) {
            for (std::size_t heading = 0; heading < HEADINGS; ++heading)
              if (leads_[std::size_t(cell)] >> heading & 1u)
                reach(cell + moves_[heading], cost + lengths_[heading]);
          });
          for (Index i = 0; i < cells_; ++i)
            std::copy_n(least.begin() + inner(i * cells_), cells_, found.begin() + std::ptrdiff_t(k * count) + i * cells_);
        }
      });
    }
    return handed_over(std::move(found), {places, std::size_t(cells_), std::size_t(cells_)});
  }

private:
  Index inner(Index cell) const { return lattice_.inner(cell * HEADINGS) / HEADINGS; }

  Index cells_;
  Lattice lattice_;
  std::vector<std::uint16_t> leads_; // by cell, with a border: headings at which a move is not certainly blocked
  std::array<Index, HEADINGS> moves_{};
  std::array<double, HEADINGS> lengths_{};
};
