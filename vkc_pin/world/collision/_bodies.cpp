// Forward kinematics by the instantiations in libpinocchio, so that results equal those from Python
// bit for bit.

#include "bodies.hpp"

#include <algorithm>
#include <mutex>
#include <stdexcept>
#include <utility>
#include <vector>

#undef PINOCCHIO_WITH_COLLISION // it would require octomap
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/config.hpp>
#include <pinocchio/multibody.hpp>
#include <pinocchio/serialization.hpp>

namespace vkc_pin {

const char * const PINOCCHIO_RELEASE = PINOCCHIO_VERSION;

namespace {

pinocchio::SE3 placement(const double * numbers)
{
  return pinocchio::SE3(Eigen::Map<const Eigen::Matrix3d>(numbers), Eigen::Map<const Eigen::Vector3d>(numbers + 9));
}

} // namespace

struct Bodies::Placing::Work
{
  explicit Work(const Known & known);

  pinocchio::Data data;
  Eigen::VectorXd q;
  std::vector<double> shapes, rotations, translations;
};

struct Bodies::Known
{
  pinocchio::Model model;
  std::vector<std::size_t> joints;
  std::vector<pinocchio::SE3> placements;
  // Pool of unused work buffers, whose construction takes longer than their use.
  std::vector<std::unique_ptr<Placing::Work>> idle;
  std::mutex mutex;
};

Bodies::Placing::Work::Work(const Known & known)
: data(known.model), q(known.model.nq), shapes(PLACEMENT * known.joints.size()), rotations(9 * known.model.njoints),
  translations(3 * known.model.njoints)
{
}

Bodies::Bodies(const std::string & model, std::size_t shapes, const std::int64_t * joints, const double * placements)
: known_(std::make_unique<Known>())
{
  boost::asio::streambuf buffer;
  buffer.commit(boost::asio::buffer_copy(buffer.prepare(model.size()), boost::asio::buffer(model)));
  pinocchio::Model loaded;
  loaded.loadFromBinary(buffer);
  // Pinocchio 4.1 does not serialize `m_nqExtended` of mimic joints and would read out of bounds; a
  // cast initializes it.
  known_->model = loaded.cast<double>();
  for (std::size_t k = 0; k < shapes; ++k)
  {
    if (joints[k] < 0 || joints[k] >= known_->model.njoints)
      throw std::out_of_range("no such joint");
    known_->joints.push_back(std::size_t(joints[k]));
    known_->placements.push_back(placement(placements + PLACEMENT * k));
  }
}

Bodies::~Bodies() = default;

std::size_t Bodies::shapes() const { return known_->joints.size(); }

std::size_t Bodies::joints() const { return std::size_t(known_->model.njoints); }

std::size_t Bodies::coordinates() const { return std::size_t(known_->model.nq); }

Bodies::Placing::Placing(const Bodies & bodies) : bodies_(bodies)
{
  Known & known = *bodies.known_;
  {
    const std::lock_guard<std::mutex> lock(known.mutex);
    if (!known.idle.empty())
    {
      work_ = std::move(known.idle.back());
      known.idle.pop_back();
    }
  }
  if (!work_)
    work_ = std::make_unique<Work>(known);
}

Bodies::Placing::~Placing()
{
  Known & known = *bodies_.known_;
  const std::lock_guard<std::mutex> lock(known.mutex);
  known.idle.push_back(std::move(work_));
}

void Bodies::Placing::at(const double * configuration)
{
  const Known & known = *bodies_.known_;
  Work & work = *work_;
  std::copy_n(configuration, work.q.size(), work.q.data());
  pinocchio::forwardKinematics(known.model, work.data, work.q);
  for (std::size_t j = 0; j < work.data.oMi.size(); ++j)
  {
    const auto & placed = work.data.oMi[j];
    Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(work.rotations.data() + 9 * j) = placed.rotation();
    Eigen::Map<Eigen::Vector3d>(work.translations.data() + 3 * j) = placed.translation();
  }
  for (std::size_t k = 0; k < known.joints.size(); ++k)
  {
    const std::size_t joint = known.joints[k];
    const pinocchio::SE3 placed = joint ? work.data.oMi[joint] * known.placements[k] : known.placements[k];
    double * numbers = work.shapes.data() + PLACEMENT * k;
    Eigen::Map<Eigen::Matrix3d>{numbers} = placed.rotation();
    Eigen::Map<Eigen::Vector3d>{numbers + 9} = placed.translation();
  }
}

const double * Bodies::Placing::shapes() const { return work_->shapes.data(); }

const double * Bodies::Placing::rotations() const { return work_->rotations.data(); }

const double * Bodies::Placing::translations() const { return work_->translations.data(); }

} // namespace vkc_pin
