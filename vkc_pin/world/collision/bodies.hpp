// Placements of shapes or frames on the joints of a Pinocchio model, their Jacobians, and inverse dynamics.
//
// Models are passed in serialized form, so that this module shares no C++ objects with Pinocchio's
// Python bindings; the kinematics are computed by the same libpinocchio. Only the translation unit
// of this class includes Pinocchio.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

namespace vkc_pin {

constexpr std::size_t PLACEMENT = 12; // numbers: the columns of a rotation, then the translation

class Bodies
{
public:
  // Serialized model; number of shapes, their joints (0: the world) and placements on these, 12
  // numbers each.
  Bodies(const std::string & model, std::size_t shapes, const std::int64_t * joints, const double * placements);
  ~Bodies();

  std::size_t shapes() const;
  std::size_t joints() const; // including joint 0, the world
  std::size_t coordinates() const;
  std::size_t velocities() const;

  // Evaluates the kinematics; not thread-safe.
  class Kinematics
  {
  public:
    explicit Kinematics(const Bodies & bodies);
    ~Kinematics();

    void compute(const double * configuration);

    // Writes the Jacobians of the shapes at their origins in the axes of the world, 6 x velocities numbers each, row-major.
    void compute_jacobians(const double * configuration, double * jacobians);

    const double * shapes() const;       // placements of the shapes, 12 numbers each
    const double * rotations() const;    // of the joints, 9 numbers each, row-major
    const double * translations() const; // of the joints, 3 numbers each

    // Writes the torques at velocities and accelerations.
    void compute_inverse_dynamics(
      const double * configuration, const double * velocity, const double * acceleration, double * torques);

  private:
    struct Work;
    const Bodies & bodies_;
    std::unique_ptr<Work> work_;
    friend class Bodies;
  };

private:
  struct Shared;
  std::unique_ptr<Shared> shared_;
};

extern const char * const PINOCCHIO_RELEASE; // release that this module was compiled against

} // namespace vkc_pin
