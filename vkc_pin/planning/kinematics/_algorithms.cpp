// Instantiates Pinocchio's algorithms on casadi::SX for all joint types, the slowest part of _cpin
// to compile.

#include "_cpin.hpp"

#include <pinocchio/algorithm/center-of-mass.hpp>
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>

namespace vkc_pin::algorithms {

void forward_kinematics(const Model & model, Data & data, const Vector & q)
{
  pinocchio::forwardKinematics(model, data, q);
}

Data::Matrix6x frame_jacobian(
  const Model & model, Data & data, const Vector & q, std::size_t frame, int reference)
{
  // Passing `q` to computeJointJacobians would instantiate another forward pass over the joints.
  pinocchio::forwardKinematics(model, data, q);
  pinocchio::computeJointJacobians(model, data);
  Data::Matrix6x jacobian = Data::Matrix6x::Zero(6, model.nv);
  pinocchio::getFrameJacobian(
    model, data, model.frames.at(frame).parentJoint, model.frames.at(frame).placement,
    static_cast<pinocchio::ReferenceFrame>(reference), jacobian);
  return jacobian;
}

void inverse_dynamics(
  const Model & model, Data & data, const Vector & q, const Vector & v, const Vector & a)
{
  pinocchio::rnea(model, data, q, v, a);
}

void center_of_mass(const Model & model, Data & data, const Vector & q)
{
  pinocchio::centerOfMass(model, data, q, false);
}

} // namespace vkc_pin::algorithms
