// Where shapes on the joints of a Pinocchio model are, at one configuration after the other.
//
// A model comes in as Pinocchio serialises it, so that this module shares no C++ object with Pinocchio's Python bindings; the
// kinematics are computed by the same libpinocchio as theirs. In a unit of its own, which alone includes Pinocchio.
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
  // The model; of `shapes` shapes the joints that carry them (0: the world) and their placements there, 12 numbers each.
  Bodies(const std::string & model, std::size_t shapes, const std::int64_t * joints, const double * placements);
  ~Bodies();

  std::size_t shapes() const;
  std::size_t joints() const; // with joint 0, the world
  std::size_t coordinates() const;

  // Where they are; for one thread at a time.
  class Placing
  {
  public:
    explicit Placing(const Bodies & bodies);
    ~Placing();

    void at(const double * configuration);

    const double * shapes() const;       // placements of the shapes, 12 numbers each
    const double * rotations() const;    // of the joints, 9 numbers each, by rows
    const double * translations() const; // of the joints, 3 numbers each

  private:
    struct Work;
    const Bodies & bodies_;
    std::unique_ptr<Work> work_;
    friend class Bodies;
  };

private:
  struct Known;
  std::unique_ptr<Known> known_;
};

extern const char * const PINOCCHIO_RELEASE; // that this was compiled against

} // namespace vkc_pin
