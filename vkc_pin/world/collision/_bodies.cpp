// Forward kinematics by the instantiations in libpinocchio, so that results equal those from Python
// bit for bit.

#include "bodies.hpp"

#include <algorithm>
#include <mutex>
#include <stdexcept>
#include <utility>
#include <vector>

#undef PINOCCHIO_WITH_COLLISION // it would require octomap
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/config.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>

namespace vkc_pin {

const char * const PINOCCHIO_RELEASE = PINOCCHIO_VERSION;

namespace {

pinocchio::SE3 to_placement(const double * numbers)
{
  return pinocchio::SE3(Eigen::Map<const Eigen::Matrix3d>(numbers), Eigen::Map<const Eigen::Vector3d>(numbers + 9));
}

} // namespace

struct Bodies::Kinematics::Work
{
  explicit Work(const Shared & shared);

  pinocchio::Data data;
  Eigen::VectorXd q, v, a;
  std::vector<double> shapes, rotations, translations;
};

struct Bodies::Shared
{
  pinocchio::Model model;
  std::vector<std::size_t> joints;
  std::vector<pinocchio::SE3> placements;
  // Pool of unused work buffers, whose construction takes longer than their use.
  std::vector<std::unique_ptr<Kinematics::Work>> idle;
  std::mutex mutex;
};

Bodies::Kinematics::Work::Work(const Shared & shared)
: data(shared.model), q(shared.model.nq), shapes(PLACEMENT * shared.joints.size()), rotations(9 * shared.model.njoints),
  translations(3 * shared.model.njoints)
{
}

Bodies::Bodies(const std::string & model, std::size_t shapes, const std::int64_t * joints, const double * placements)
: shared_(std::make_unique<Shared>())
{
  boost::asio::streambuf buffer;
  buffer.commit(boost::asio::buffer_copy(buffer.prepare(model.size()), boost::asio::buffer(model)));
  pinocchio::Model loaded;
  loaded.loadFromBinary(buffer);
  // Pinocchio 4.1 does not serialize `m_nqExtended` of mimic joints and would read out of bounds; a
  // cast initializes it.
  shared_->model = loaded.cast<double>();
  for (std::size_t k = 0; k < shapes; ++k)
  {
    if (joints[k] < 0 || joints[k] >= shared_->model.njoints)
      throw std::out_of_range("no such joint");
    shared_->joints.push_back(std::size_t(joints[k]));
    shared_->placements.push_back(to_placement(placements + PLACEMENT * k));
  }
}

Bodies::~Bodies() = default;

std::size_t Bodies::shapes() const { return shared_->joints.size(); }

std::size_t Bodies::joints() const { return std::size_t(shared_->model.njoints); }

std::size_t Bodies::coordinates() const { return std::size_t(shared_->model.nq); }

std::size_t Bodies::velocities() const { return std::size_t(shared_->model.nv); }

Bodies::Kinematics::Kinematics(const Bodies & bodies) : bodies_(bodies)
{
  Shared & shared = *bodies.shared_;
  {
    const std::lock_guard<std::mutex> lock(shared.mutex);
    if (!shared.idle.empty())
    {
      work_ = std::move(shared.idle.back());
      shared.idle.pop_back();
    }
  }
  if (!work_)
    work_ = std::make_unique<Work>(shared);
}

Bodies::Kinematics::~Kinematics()
{
  Shared & shared = *bodies_.shared_;
  const std::lock_guard<std::mutex> lock(shared.mutex);
  shared.idle.push_back(std::move(work_));
}

void Bodies::Kinematics::compute(const double * configuration)
{
  const Shared & shared = *bodies_.shared_;
  Work & work = *work_;
  std::copy_n(configuration, work.q.size(), work.q.data());
  pinocchio::forwardKinematics(shared.model, work.data, work.q);
  for (std::size_t j = 0; j < work.data.oMi.size(); ++j)
  {
    const auto & placed = work.data.oMi[j];
    Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(work.rotations.data() + 9 * j) = placed.rotation();
    Eigen::Map<Eigen::Vector3d>(work.translations.data() + 3 * j) = placed.translation();
  }
  for (std::size_t k = 0; k < shared.joints.size(); ++k)
  {
    const std::size_t joint = shared.joints[k];
    const pinocchio::SE3 placed = joint ? work.data.oMi[joint] * shared.placements[k] : shared.placements[k];
    double * numbers = work.shapes.data() + PLACEMENT * k;
    Eigen::Map<Eigen::Matrix3d>{numbers} = placed.rotation();
    Eigen::Map<Eigen::Vector3d>{numbers + 9} = placed.translation();
  }
}

void Bodies::Kinematics::compute_jacobians(const double * configuration, double * jacobians)
{
  using RowMajor = Eigen::Matrix<double, 6, Eigen::Dynamic, Eigen::RowMajor>;
  const Shared & shared = *bodies_.shared_;
  Work & work = *work_;
  std::copy_n(configuration, work.q.size(), work.q.data());
  pinocchio::computeJointJacobians(shared.model, work.data, work.q);
  pinocchio::Data::Matrix6x jacobian(6, shared.model.nv);
  for (std::size_t k = 0; k < shared.joints.size(); ++k)
  {
    jacobian.setZero();
    if (shared.joints[k])
      pinocchio::getFrameJacobian(
        shared.model, work.data, shared.joints[k], shared.placements[k], pinocchio::LOCAL_WORLD_ALIGNED, jacobian);
    Eigen::Map<RowMajor>(jacobians + k * std::size_t(jacobian.size()), 6, shared.model.nv) = jacobian;
  }
}

void Bodies::Kinematics::compute_inverse_dynamics(
  const double * configuration, const double * velocity, const double * acceleration, double * torques)
{
  using Vector = Eigen::Map<const Eigen::VectorXd>;
  const Shared & shared = *bodies_.shared_;
  Work & work = *work_;
  std::copy_n(configuration, work.q.size(), work.q.data());
  work.v = Vector(velocity, shared.model.nv);
  work.a = Vector(acceleration, shared.model.nv);
  Eigen::Map<Eigen::VectorXd>(torques, shared.model.nv) = pinocchio::rnea(shared.model, work.data, work.q, work.v, work.a);
}

const double * Bodies::Kinematics::shapes() const { return work_->shapes.data(); }

const double * Bodies::Kinematics::rotations() const { return work_->rotations.data(); }

const double * Bodies::Kinematics::translations() const { return work_->translations.data(); }

} // namespace vkc_pin
