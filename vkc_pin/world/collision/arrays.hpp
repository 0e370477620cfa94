// Array types for the Python interface, and parallel loops.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <initializer_list>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace nb = nanobind;

using Index = std::int64_t;
template<int dimensions>
using Numbers = nb::ndarray<const double, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template<int dimensions>
using Indices = nb::ndarray<const Index, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template<typename T>
using Array = nb::ndarray<nb::numpy, T, nb::c_contig, nb::device::cpu>;

// Calls work(part, first, last) on parts of 0..count, each in its own thread, and rethrows the
// first exception of any part.
template<typename Work>
void in_parts(std::size_t count, std::size_t threads, const Work & work)
{
  threads = std::min(std::max<std::size_t>(threads, 1), std::max<std::size_t>(count, 1));
  if (threads == 1)
    return work(std::size_t(0), std::size_t(0), count);
  std::vector<std::exception_ptr> failures(threads);
  std::vector<std::thread> others;
  const auto part = [&](std::size_t k) {
    try
    {
      work(k, count * k / threads, count * (k + 1) / threads);
    }
    catch (...)
    {
      failures[k] = std::current_exception();
    }
  };
  std::size_t started = 1;
  try
  {
    for (; started < threads; ++started)
      others.emplace_back(part, started);
  }
  catch (const std::system_error &) // no more threads available: the remaining parts run in this thread
  {
  }
  part(0);
  for (std::size_t k = started; k < threads; ++k)
    part(k);
  for (auto & other : others)
    other.join();
  for (const auto & failure : failures)
    if (failure)
      std::rethrow_exception(failure);
}

template<typename T>
Array<T> handed_over(std::vector<T> && numbers, std::initializer_list<std::size_t> shape)
{
  auto * kept = new std::vector<T>(std::move(numbers));
  nb::capsule owner(kept, [](void * p) noexcept { delete static_cast<std::vector<T> *>(p); });
  return Array<T>(kept->data(), shape, owner);
}
