// The linear solver of Ipopt's systems. Ipopt loads it at run time (its options `hsllib` and `linear_solver`) and speaks to it in
// the C interface of HSL_MA97, of which this is what Ipopt uses; https://www.hsl.rl.ac.uk/catalogue/hsl_ma97.html describes it.

#include <cstring>
#include <new>
#include <stdexcept>

#include "../distances/arrays.hpp"
#include "factorization.hpp"

namespace
{

// The names and layouts of ma97_control_d and ma97_info_d.
struct Control
{
  int f_arrays, action, nemin;
  double multiplier;
  int ordering, print_level, scaling;
  double small, u;
  int unit_diagnostics, unit_error, unit_warning;
  long factor_min;
  int solve_blas3;
  long solve_min;
  int solve_mf;
  double consist_tol;
  int ispare[5];
  double rspare[10];
};

struct Info
{
  int flag, flag68, flag77, matrix_dup, matrix_rank, matrix_outrange, matrix_missing_diag, maxdepth, maxfront, num_delay;
  long num_factor, num_flops;
  int num_neg, num_sup, num_two, ordering, stat;
  int ispare[5];
  double rspare[10];
};

enum Flag
{
  DONE = 0,
  NO_MEMORY = -1,
  SINGULAR = -7
};

// Calls work, and notes in `info` how that went; no exception leaves it.
template<typename Work>
void noted(Info * info, const Work & work)
{
  std::memset(info, 0, sizeof(Info));
  try
  {
    info->flag = work();
  }
  catch (const std::bad_alloc &)
  {
    info->flag = NO_MEMORY;
  }
}

Factorization & factorization(void ** akeep) { return *static_cast<Factorization *>(*akeep); }

} // namespace

extern "C"
{
#define EXPORTED __attribute__((visibility("default")))

EXPORTED void ma97_default_control_d(Control * control) { std::memset(control, 0, sizeof(Control)); }

EXPORTED void ma97_free_akeep_d(void ** akeep)
{
  delete static_cast<Factorization *>(*akeep);
  *akeep = nullptr;
}

EXPORTED void ma97_finalise_d(void ** akeep, void ** fkeep)
{
  ma97_free_akeep_d(akeep);
  *fkeep = nullptr;
}

EXPORTED void ma97_analyse_d(
  int, int size, const int * columns, const int * rows, double *, void ** akeep, const Control * control, Info * info, int *)
{
  ma97_free_akeep_d(akeep);
  noted(info, [&] {
    *akeep = new Factorization(std::size_t(size), columns, rows, control->f_arrays ? 1 : 0);
    return DONE;
  });
}

EXPORTED void ma97_factor_d(
  int, const int *, const int *, const double * values, void ** akeep, void **, const Control *, Info * info, double *)
{
  noted(info, [&] { return factorization(akeep).factor(values) ? DONE : SINGULAR; });
  if (info->flag == DONE)
    info->num_neg = factorization(akeep).negative();
}

EXPORTED void
ma97_solve_d(int, int count, double * x, int stride, void ** akeep, void **, const Control *, Info * info)
{
  noted(info, [&] {
    for (int k = 0; k < count; ++k)
      factorization(akeep).solve(x + std::ptrdiff_t(k) * stride);
    return DONE;
  });
}

EXPORTED void ma97_factor_solve_d(
  int type,
  const int * columns,
  const int * rows,
  const double * values,
  int count,
  double * x,
  int stride,
  void ** akeep,
  void ** fkeep,
  const Control * control,
  Info * info,
  double * scale)
{
  ma97_factor_d(type, columns, rows, values, akeep, fkeep, control, info, scale);
  if (info->flag == DONE)
    ma97_solve_d(0, count, x, stride, akeep, fkeep, control, info);
}
}

namespace
{

using Places = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void check(bool fits, const char * message)
{
  if (!fits)
    throw std::invalid_argument(message);
}

// Checks that columns and rows are those of a lower triangle.
void check_triangle(const Places & columns, const Places & rows)
{
  check(columns.shape(0) > 0 && columns(0) == 0, "columns begin with 0");
  const std::size_t size = columns.shape(0) - 1;
  for (std::size_t j = 0; j < size; ++j)
  {
    check(columns(j) <= columns(j + 1) && std::size_t(columns(j + 1)) <= rows.shape(0), "columns ascend to the number of rows");
    for (int p = columns(j); p < columns(j + 1); ++p)
      check(rows(p) >= int(j) && rows(p) < int(size), "rows are those of a lower triangle");
  }
  check(std::size_t(columns(size)) == rows.shape(0), "columns ascend to the number of rows");
}

} // namespace

NB_MODULE(_kkt, module)
{
  module.doc() = "The linear solver of Ipopt's systems.";
  nb::set_leak_warnings(false);
  nb::class_<Factorization>(module, "Factorization")
    .def(
      "__init__",
      [](Factorization * self, const Places & columns, const Places & rows) {
        check_triangle(columns, rows);
        new (self) Factorization(columns.shape(0) - 1, columns.data(), rows.data(), 0);
      })
    .def(
      "factor",
      [](Factorization & self, const Numbers<1> & values) {
        check(values.shape(0) == self.entries(), "one value for each entry");
        return self.factor(values.data());
      })
    .def(
      "solve",
      [](Factorization & self, nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu> x) {
        check(x.shape(0) == self.size() && self.factored(), "as many numbers as the matrix has rows, once it is factored");
        self.solve(x.data());
      })
    .def_prop_ro("negative", &Factorization::negative)
    .def_prop_ro("filled", &Factorization::filled);
}
