// Linear solver for Ipopt's systems. Ipopt loads it at run time (options `hsllib` and
// `linear_solver`) through the interface of HSL's MA27, as far as Ipopt uses it:
// https://www.hsl.rl.ac.uk/archive/specs/ma27.pdf. Why not MUMPS: docs/decisions/0009.

#include <algorithm>
#include <limits>
#include <memory>
#include <new>

#include <nanobind/nanobind.h>

#include "factorization.hpp"

namespace
{

// MA27 stores its state in the caller's arrays. Here they hold only the number of a system: each
// thread has one at a time.
struct System
{
  int number = 0;
  std::unique_ptr<Factorization> factorization;
};

thread_local System current;

Factorization * system(int number) { return number == current.number ? current.factorization.get() : nullptr; }

// Indices of `info`, and its values.
enum Field
{
  FLAG = 0,
  REALS = 4,
  INTEGERS = 5,
  NEGATIVE = 14,
  FIELDS = 20
};
enum Flag
{
  DONE = 0,
  NO_SYSTEM = -1,
  NO_MEMORY = -2,
  SINGULAR = -5
};

// Calls a function and stores its result in `info`; catches allocation failures.
template<typename Work>
void report(int * info, const Work & work)
{
  std::fill(info, info + FIELDS, 0);
  try
  {
    info[FLAG] = work();
  }
  catch (const std::bad_alloc &)
  {
    info[FLAG] = NO_MEMORY;
  }
}

} // namespace

extern "C"
{
#define EXPORTED __attribute__((visibility("default")))

// Sets the options: there are none.
EXPORTED void ma27id_(int * integers, double * reals)
{
  std::fill(integers, integers + 30, 0);
  std::fill(reals, reals + 5, 0.0);
}

// Analyses the sparsity pattern.
EXPORTED void ma27ad_(
  const int * size,
  const int * entries,
  const int * rows,
  const int * columns,
  int *,
  const int *,
  int * keep,
  int *,
  int * steps,
  const int *,
  const int *,
  const double *,
  int * info,
  double * operations)
{
  report(info, [&] {
    current.factorization = std::make_unique<Factorization>(*size, *entries, rows, columns);
    keep[0] = current.number = current.number % std::numeric_limits<int>::max() + 1;
    return DONE;
  });
  *steps = 1;
  *operations = 0.0;
  info[REALS] = *entries;
  info[INTEGERS] = 1;
}

// Factors the matrix.
EXPORTED void ma27bd_(
  const int *,
  const int *,
  const int *,
  const int *,
  const double * values,
  const int *,
  int * kept,
  const int *,
  const int * keep,
  const int *,
  int * front,
  int *,
  const int *,
  const double *,
  int * info)
{
  Factorization * const found = system(keep[0]);
  report(info, [&] { return !found ? NO_SYSTEM : found->factor(values) ? DONE : SINGULAR; });
  kept[0] = keep[0];
  *front = 1;
  if (found)
    info[NEGATIVE] = found->negative();
}

// Solves the system.
EXPORTED void ma27cd_(
  const int * size,
  const double *,
  const int *,
  const int * kept,
  const int *,
  double *,
  const int *,
  double * x,
  int *,
  const int *,
  const int *,
  const double *)
{
  if (Factorization * const found = system(kept[0]); found && found->factored())
    found->solve(x);
  else
    std::fill(x, x + *size, std::numeric_limits<double>::quiet_NaN());
}
}

NB_MODULE(_kkt, module)
{
  module.doc() = "The linear solver of Ipopt's systems, which Ipopt loads as a library.";
}
