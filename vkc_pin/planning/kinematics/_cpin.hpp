// Declarations shared by the two translation units of the module _cpin, which are compiled in
// parallel: _cpin.cpp loads models and creates their data, _algorithms.cpp instantiates the
// algorithms for all joint types.
#pragma once

#include <cstddef>

#include <pinocchio/autodiff/casadi.hpp>  // must precede the other headers of Pinocchio

#include <pinocchio/multibody.hpp>

namespace vkc_pin {

using casadi::SX;
using Model = pinocchio::ModelTpl<SX>;
using Data = pinocchio::DataTpl<SX>;
using SE3 = pinocchio::SE3Tpl<SX>;
using Vector = Eigen::Matrix<SX, Eigen::Dynamic, 1>;

// Defined in _algorithms.cpp. The results are stored in `data`, except the returned Jacobian.
namespace algorithms {

void forward_kinematics(const Model & model, Data & data, const Vector & q);
Data::Matrix6x frame_jacobian(
  const Model & model, Data & data, const Vector & q, std::size_t frame, int reference);
void inverse_dynamics(
  const Model & model, Data & data, const Vector & q, const Vector & v, const Vector & a);
void center_of_mass(const Model & model, Data & data, const Vector & q);

} // namespace algorithms

} // namespace vkc_pin
