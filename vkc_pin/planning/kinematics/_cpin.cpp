// Python module with Pinocchio's algorithms on casadi::SX.
//
// Models and functions are exchanged with Python as text: a pinocchio::Model as serialised by
// Pinocchio, a casadi::Function as serialised by CasADi. The module shares no C++ objects with the
// Python bindings of these libraries, and therefore need not be built with the same compilers.

#include "_cpin.hpp"

#include <string>
#include <vector>

#include <pinocchio/config.hpp>
#include <pinocchio/serialization.hpp>

#include <casadi/casadi.hpp>
#include <casadi/config.h>

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

namespace nb = nanobind;

namespace {

using casadi::Function;
using namespace vkc_pin;

Model load(const std::string & text)
{
  pinocchio::Model model;
  model.loadFromString(text);
  return model.cast<SX>();
}

Vector to_eigen(const SX & column)
{
  Vector vector(column.size1());
  for (casadi_int i = 0; i < column.size1(); ++i)
    vector[i] = column(i);
  return vector;
}

template<typename Matrix>
SX to_casadi(const Eigen::MatrixBase<Matrix> & matrix)
{
  SX result(matrix.rows(), matrix.cols());  // entries that are not set are structural zeros
  for (Eigen::Index j = 0; j < matrix.cols(); ++j)
    for (Eigen::Index i = 0; i < matrix.rows(); ++i)
    {
      const SX & entry = matrix(i, j);
      if (!entry.is_zero())
        result(i, j) = entry;
    }
  return result;
}

SX column(const SE3 & placement)
{
  return SX::vertcat(
    {SX::vec(to_casadi(placement.rotation())), to_casadi(placement.translation())});
}

std::string pack(
  const std::string & name,
  const std::vector<SX> & in,
  const SX & out,
  const std::vector<std::string> & names_in,
  const std::string & name_out)
{
  return Function(name, in, {cse(out)}, names_in, {name_out}).serialize();
}

// The inverse of `column`.
SE3 to_placement(const SX & column)
{
  SE3 placement;
  for (casadi_int i = 0; i < 9; ++i)
    placement.rotation()(i % 3, i / 3) = column(i);
  for (casadi_int i = 0; i < 3; ++i)
    placement.translation()[i] = column(9 + i);
  return placement;
}

std::string joint_placements(const std::string & text, const std::vector<std::size_t> & given)
{
  Model model = load(text);
  Data data(model);
  const SX q = SX::sym("q", model.nq), mounts = SX::sym("P", 12, given.size());
  for (std::size_t i = 0; i < given.size(); ++i)
    model.jointPlacements.at(given[i]) =
      to_placement(mounts(casadi::Slice(), static_cast<casadi_int>(i)));
  algorithms::forward_kinematics(model, data, to_eigen(q));
  std::vector<SX> columns{SX(12, 0)};
  for (std::size_t i = 1; i < data.oMi.size(); ++i)
    columns.push_back(column(data.oMi[i]));
  const SX placements = SX::horzcat(columns);
  if (given.empty())
    return pack("joint_placements", {q}, placements, {"q"}, "M");
  return pack("joint_placements", {q, mounts}, placements, {"q", "P"}, "M");
}

std::string frame_placements(const std::string & text, const std::vector<std::size_t> & frames)
{
  const Model model = load(text);
  Data data(model);
  const SX q = SX::sym("q", model.nq);
  algorithms::forward_kinematics(model, data, to_eigen(q));
  std::vector<SX> columns{SX(12, 0)};
  for (const std::size_t i : frames)
  {
    const auto & frame = model.frames.at(i);
    columns.push_back(column(data.oMi[frame.parentJoint] * frame.placement));
  }
  return pack("frame_placements", {q}, SX::horzcat(columns), {"q"}, "M");
}

std::string frame_jacobian(const std::string & text, std::size_t frame, int reference)
{
  const Model model = load(text);
  Data data(model);
  const SX q = SX::sym("q", model.nq);
  const Data::Matrix6x jacobian =
    algorithms::frame_jacobian(model, data, to_eigen(q), frame, reference);
  return pack("frame_jacobian", {q}, to_casadi(jacobian), {"q"}, "J");
}

std::string rnea(const std::string & text)
{
  const Model model = load(text);
  Data data(model);
  const SX q = SX::sym("q", model.nq), v = SX::sym("v", model.nv), a = SX::sym("a", model.nv);
  algorithms::inverse_dynamics(model, data, to_eigen(q), to_eigen(v), to_eigen(a));
  return pack("rnea", {q, v, a}, to_casadi(data.tau), {"q", "v", "a"}, "tau");
}

std::string center_of_mass(const std::string & text)
{
  const Model model = load(text);
  Data data(model);
  const SX q = SX::sym("q", model.nq);
  algorithms::center_of_mass(model, data, to_eigen(q));
  return pack("center_of_mass", {q}, to_casadi(data.com[0]), {"q"}, "com");
}

} // namespace

NB_MODULE(_cpin, module)
{
  module.doc() = "Pinocchio's algorithms on casadi::SX; models and functions cross as text.";
  module.attr("PINOCCHIO_VERSION") = PINOCCHIO_VERSION;
  module.attr("CASADI_VERSION") = CASADI_VERSION_STRING;
  module.def("joint_placements", &joint_placements);
  module.def("frame_placements", &frame_placements);
  module.def("frame_jacobian", &frame_jacobian);
  module.def("rnea", &rnea);
  module.def("center_of_mass", &center_of_mass);
}
