// What the two units of the module _cpin share. They are compiled at the same time, and each instantiates what the other
// does not: _cpin.cpp reads a model and makes its data, _algorithms.cpp walks over the joints of all types.
#pragma once

#include <cstddef>

#include <pinocchio/autodiff/casadi.hpp>  // before the rest of Pinocchio

#include <pinocchio/multibody.hpp>

namespace vkc_pin {

using casadi::SX;
using Model = pinocchio::ModelTpl<SX>;
using Data = pinocchio::DataTpl<SX>;
using SE3 = pinocchio::SE3Tpl<SX>;
using Vector = Eigen::Matrix<SX, Eigen::Dynamic, 1>;

// In _algorithms.cpp. Each writes what it finds into `data`, but for the Jacobian.
namespace algorithms {

void forward_kinematics(const Model & model, Data & data, const Vector & q);
Data::Matrix6x frame_jacobian(const Model & model, Data & data, const Vector & q, std::size_t frame, int reference);
void inverse_dynamics(const Model & model, Data & data, const Vector & q, const Vector & v, const Vector & a);
void center_of_mass(const Model & model, Data & data, const Vector & q);

} // namespace algorithms

} // namespace vkc_pin
