// Signed distances of two placed shapes, by coal, with the cases corrected that coal 3.0 gets wrong
// when round shapes overlap.
//
// A sphere is a point, a capsule a segment, each swept by a sphere: its core. coal computes these
// pairs in closed form, and their distances and normals are wrong where cores meet:
// - of a sphere whose centre is inside a cylinder, it considers the lateral surface only;
// - of spheres and capsules whose cores meet, the normal is zero or the direction of a rounding
//   error.
#pragma once

#include <cmath>

#include <coal/distance.h>
#include <coal/shape/geometric_shapes.h>

namespace {

// With coal's default of 64, the depth of rounded shapes on a common axis is off by up to 3 mm.
constexpr std::size_t EPA_ITERATIONS = 256;
constexpr double MEETING = 1e-9; // distance of cores below which their direction is rounding [m]

using coal::Transform3s;
using coal::Vec3s;

inline coal::DistanceRequest make_request(double tolerance)
{
  coal::DistanceRequest request;
  request.gjk_tolerance = tolerance;
  request.epa_max_iterations = EPA_ITERATIONS;
  return request;
}

struct Core // of a sphere or a capsule
{
  Vec3s centre, axis; // the axis of a sphere is zero
  double radius;
};

inline bool is_round(const coal::CollisionGeometry & shape)
{
  return shape.getNodeType() == coal::GEOM_SPHERE || shape.getNodeType() == coal::GEOM_CAPSULE;
}

inline Core get_core(const coal::CollisionGeometry & shape, const Transform3s & where)
{
  const double swept = static_cast<const coal::ShapeBase &>(shape).getSweptSphereRadius();
  if (shape.getNodeType() == coal::GEOM_SPHERE)
    return {where.getTranslation(), Vec3s::Zero(), static_cast<const coal::Sphere &>(shape).radius + swept};
  const auto & capsule = static_cast<const coal::Capsule &>(shape);
  return {where.getTranslation(), where.getRotation().col(2), capsule.radius + swept};
}

// A unit vector perpendicular to both vectors, either of which may be zero.
inline Vec3s find_perpendicular(const Vec3s & one, const Vec3s & other)
{
  const Vec3s across = one.cross(other);
  if (across.norm() > MEETING)
    return across.normalized();
  const Vec3s & axis = one.isZero() ? other : one;
  Eigen::Index least;
  axis.cwiseAbs().minCoeff(&least);
  return axis.isZero() ? Vec3s(Vec3s::UnitX()) : Vec3s(axis.cross(Vec3s::Unit(least)).normalized());
}

inline void set_result(coal::DistanceResult & result, double distance, const Vec3s & normal, const Vec3s & first)
{
  result.min_distance = distance;
  result.normal = normal;
  result.nearest_points[0] = first;
  result.nearest_points[1] = first + distance * normal;
}

// Any direction across both cores separates them, where these meet.
inline void separate_cores(const Core & one, const Core & other, coal::DistanceResult & result)
{
  const double distance = result.min_distance;
  if (distance + one.radius + other.radius > MEETING)
    return;
  const Vec3s normal = find_perpendicular(one.axis, other.axis);
  // coal's witness points of meeting cores lie on the surfaces, opposite each other.
  const double fraction = one.radius / (one.radius + other.radius);
  const Vec3s meeting = result.nearest_points[0] * (1.0 - fraction) + result.nearest_points[1] * fraction;
  set_result(result, distance, normal, meeting + one.radius * normal);
}

// The nearest surface of a cylinder may be its lateral surface or one of its ends.
inline void leave_cylinder(
  const coal::Cylinder & cylinder,
  const Transform3s & where,
  const Core & sphere,
  bool sphere_is_first,
  coal::DistanceResult & result)
{
  const Vec3s centre = where.getRotation().transpose() * (sphere.centre - where.getTranslation());
  const double radial = cylinder.radius - centre.head<2>().norm();
  const double axial = cylinder.halfLength - std::abs(centre.z());
  if (radial < 0.0 || axial < 0.0)
    return;
  Vec3s outwards = Vec3s::Zero();
  if (axial < radial)
    outwards.z() = std::copysign(1.0, centre.z());
  else if (centre.head<2>().norm() > 0.0)
    outwards.head<2>() = centre.head<2>().normalized();
  else
    outwards.x() = 1.0;
  outwards = where.getRotation() * outwards;
  const double surface = std::min(radial, axial) + cylinder.getSweptSphereRadius();
  const double distance = -surface - sphere.radius;
  if (sphere_is_first)
    set_result(result, distance, -outwards, sphere.centre - sphere.radius * outwards);
  else
    set_result(result, distance, outwards, sphere.centre + surface * outwards);
}

inline double signed_distance_of_solids(
  const coal::CollisionGeometry & one,
  const Transform3s & where,
  const coal::CollisionGeometry & other,
  const Transform3s & there,
  const coal::DistanceRequest & request,
  coal::DistanceResult & result)
{
  const double distance = coal::distance(&one, where, &other, there, request, result);
  if (distance > 0.0 || !(is_round(one) || is_round(other)))
    return distance;
  if (is_round(one) && is_round(other))
    separate_cores(get_core(one, where), get_core(other, there), result);
  else if (one.getNodeType() == coal::GEOM_CYLINDER && other.getNodeType() == coal::GEOM_SPHERE)
    leave_cylinder(static_cast<const coal::Cylinder &>(one), where, get_core(other, there), false, result);
  else if (one.getNodeType() == coal::GEOM_SPHERE && other.getNodeType() == coal::GEOM_CYLINDER)
    leave_cylinder(static_cast<const coal::Cylinder &>(other), there, get_core(one, where), true, result);
  return result.min_distance;
}

} // namespace
