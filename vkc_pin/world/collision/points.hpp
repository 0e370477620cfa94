// Fixed points of one radius, and signed distances of other shapes to them.
//
// coal has three representations of measured surfaces: octrees, meshes of degenerate triangles and
// height fields. Their distances are wrong in penetration or ten times as expensive; see
// docs/decisions/0038. Here points are sorted into cells. Of each shape, closed forms or face planes
// bound the distance of a point from below, and coal computes those few that the bounds leave.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <stdexcept>
#include <vector>

#include <coal/distance.h>
#include <coal/shape/convex.h>
#include <coal/shape/geometric_shapes.h>

#include "arrays.hpp"
#include "overlaps.hpp"
#include "vectors.hpp"

namespace {

constexpr double CELL_SIZE = 0.1;      // [m]; from 3 to 20 cm, times differ by less than half
constexpr double PLANE_ROUNDING = 1e-9; // [m] above a hull's planes within which a point is on its surface

// A convex hull with the planes n·x = d of its faces, one for each plane.
struct Hull : coal::Convex<coal::Triangle>
{
  struct Face
  {
    Vector normal;
    double offset;
  };

  Hull(
    const std::shared_ptr<std::vector<coal::Vec3s>> & corners,
    const std::shared_ptr<std::vector<coal::Triangle>> & triangles)
  : coal::Convex<coal::Triangle>(corners, unsigned(corners->size()), triangles, unsigned(triangles->size()))
  {
    coal::Vec3s middle = coal::Vec3s::Zero();
    for (const auto & corner : *corners)
      middle += corner / double(corners->size());
    for (const auto & triangle : *triangles)
    {
      const coal::Vec3s & first = (*corners)[triangle[0]];
      coal::Vec3s normal = ((*corners)[triangle[1]] - first).cross((*corners)[triangle[2]] - first);
      if (normal.norm() < 1e-14)
        continue; // [m²]: no area, hence no direction
      normal.normalize();
      if (normal.dot(first - middle) < 0.0)
        normal = -normal;
      add_face(normal, *corners);
    }
  }

  std::vector<Face> faces;

private:
  void add_face(const coal::Vec3s & normal, const std::vector<coal::Vec3s> & corners)
  {
    constexpr double same = 1.0 - 1e-12; // cosine of the angle between normals of triangles of one face
    for (const Face & face : faces)
      if (normal[0] * face.normal.x[0] + normal[1] * face.normal.x[1] + normal[2] * face.normal.x[2] > same)
        return;
    double offset = -std::numeric_limits<double>::infinity();
    for (const auto & corner : corners)
      offset = std::max(offset, normal.dot(corner));
    faces.push_back({{{normal[0], normal[1], normal[2]}}, offset});
  }
};

// Points in one frame, in cells.
class Points : public coal::CollisionGeometry
{
public:
  struct Cell
  {
    Vector center, half;
    std::size_t first, last;
  };

  Points(const Numbers<2> & points, double radius) : radius(radius)
  {
    if (points.shape(1) != 3 || !points.shape(0))
      throw std::invalid_argument("points are of shape (n, 3), with at least one point");
    std::map<std::array<Index, 3>, std::vector<std::size_t>> members;
    for (std::size_t i = 0; i < points.shape(0); ++i)
    {
      std::array<Index, 3> key;
      for (std::size_t k = 0; k < 3; ++k)
      {
        if (!(std::abs(points(i, k)) < 1e9))
          throw std::invalid_argument("a point is not finite, or too far away");
        key[k] = Index(std::floor(points(i, k) / CELL_SIZE));
      }
      members[key].push_back(i);
    }
    centers.reserve(points.shape(0));
    for (const auto & [key, indices] : members)
    {
      constexpr double far = std::numeric_limits<double>::infinity();
      Vector lower{{far, far, far}}, upper{{-far, -far, -far}};
      const std::size_t first = centers.size();
      for (const std::size_t i : indices)
      {
        centers.push_back({{points(i, 0), points(i, 1), points(i, 2)}});
        for (int k = 0; k < 3; ++k)
        {
          lower.x[k] = std::min(lower.x[k], centers.back().x[k]);
          upper.x[k] = std::max(upper.x[k], centers.back().x[k]);
        }
      }
      Cell cell{{}, {}, first, centers.size()};
      for (int k = 0; k < 3; ++k)
      {
        cell.center.x[k] = (lower.x[k] + upper.x[k]) / 2;
        cell.half.x[k] = (upper.x[k] - lower.x[k]) / 2;
      }
      cells.push_back(cell);
    }
    computeLocalAABB();
  }

  Points * clone() const override { return new Points(*this); }

  void computeLocalAABB() override
  {
    aabb_local = coal::AABB();
    for (const Vector & center : centers)
      aabb_local += coal::Vec3s(center.x[0], center.x[1], center.x[2]);
    aabb_local.expand(coal::Vec3s::Constant(radius));
    aabb_center = aabb_local.center();
    aabb_radius = (aabb_local.min_ - aabb_center).norm();
  }

  coal::NODE_TYPE getNodeType() const override { return coal::BV_UNKNOWN; }

  double radius;
  std::vector<Vector> centers; // sorted by cell
  std::vector<Cell> cells;

private:
  bool isEqual(const coal::CollisionGeometry & other) const override { return this == &other; }
};

inline bool is_points(const coal::CollisionGeometry & shape)
{
  return shape.getNodeType() == coal::BV_UNKNOWN;
}

// Finds the point nearest to one shape; all in the frame of the shape.
class NearestPoint
{
public:
  NearestPoint(const coal::CollisionGeometry & shape, double radius, double bound, const coal::DistanceRequest & request)
  : shape_(shape), ball_(radius), radius_(radius), request_(request), distance(bound)
  {
    const coal::AABB & box = shape.aabb_local;
    for (int k = 0; k < 3; ++k)
    {
      center_.x[k] = 0.5 * box.min_[k] + 0.5 * box.max_[k];
      half_.x[k] = 0.5 * box.max_[k] - 0.5 * box.min_[k];
    }
    if (shape.getObjectType() == coal::OT_GEOM)
      swept_ = static_cast<const coal::ShapeBase &>(shape).getSweptSphereRadius();
  }

  // Lower bound of the distance of points in a box around a centre.
  double bound_box(const Vector & center, const Vector & half) const
  {
    Vector outside;
    for (int k = 0; k < 3; ++k)
      outside.x[k] = std::max(std::abs(center.x[k] - center_.x[k]) - half.x[k] - half_.x[k] - swept_, 0.0);
    const double squared = square(outside);
    // Inside the bounding box nothing is known of the depth.
    return squared > 0.0 ? std::sqrt(squared) - radius_ : -std::numeric_limits<double>::infinity();
  }

  // Takes the points of a cell into account.
  template<typename Place>
  void add_cell(const Points & points, const Points::Cell & cell, const Place & place)
  {
    candidates_.clear();
    for (std::size_t i = cell.first; i < cell.last; ++i)
    {
      const Vector point = place(points.centers[i]);
      if (bound_box(point, Vector{}) < distance)
        add_point(point);
    }
    std::sort(candidates_.begin(), candidates_.end(), [](const auto & a, const auto & b) { return a.bound < b.bound; });
    for (const Candidate & candidate : candidates_)
    {
      if (candidate.bound >= distance)
        break;
      query(candidate.point);
    }
  }

  // Returns whether a point is closer than the bound.
  bool is_near(const Vector & point)
  {
    candidates_.clear();
    if (bound_box(point, Vector{}) < distance)
      add_point(point);
    if (!found && !candidates_.empty())
      query(candidates_.front().point);
    return found;
  }

  bool found = false;
  double distance;
  coal::Vec3s normal, first, second;

private:
  struct Candidate
  {
    Vector point;
    double bound;
  };

  void add_point(const Vector & point)
  {
    switch (shape_.getNodeType())
    {
    case coal::GEOM_SPHERE:
      return add_round(point, 0.0, static_cast<const coal::Sphere &>(shape_).radius);
    case coal::GEOM_CAPSULE: {
      const auto & capsule = static_cast<const coal::Capsule &>(shape_);
      return add_round(point, std::clamp(point.x[2], -capsule.halfLength, capsule.halfLength), capsule.radius);
    }
    case coal::GEOM_BOX:
      return add_box(point, static_cast<const coal::Box &>(shape_).halfSide);
    case coal::GEOM_CONVEX:
      return add_hull(point, static_cast<const Hull &>(shape_).faces);
    default:
      candidates_.push_back({point, bound_box(point, Vector{})});
    }
  }

  void keep(const Vector & point, double surface, const coal::Vec3s & direction)
  {
    const double value = surface - swept_ - radius_;
    if (value >= distance)
      return;
    found = true;
    distance = value;
    normal = direction;
    const coal::Vec3s center(point.x[0], point.x[1], point.x[2]);
    first = center - (surface - swept_) * direction;
    second = center - radius_ * direction;
  }

  // `height` is that of the nearest point of the core, on the z axis.
  void add_round(const Vector & point, double height, double radius)
  {
    const coal::Vec3s offset(point.x[0], point.x[1], point.x[2] - height);
    const double length = offset.norm();
    if (length - radius - swept_ - radius_ >= distance)
      return;
    const bool is_on_axis = length < 1e-9;
    keep(point, length - radius, is_on_axis ? coal::Vec3s(coal::Vec3s::UnitX()) : coal::Vec3s(offset / length));
  }

  void add_box(const Vector & point, const coal::Vec3s & half)
  {
    coal::Vec3s outside, towards = coal::Vec3s::Zero();
    int nearest = 0;
    for (int k = 0; k < 3; ++k)
    {
      outside[k] = std::abs(point.x[k]) - half[k];
      if (outside[k] > outside[nearest])
        nearest = k;
    }
    if (outside[nearest] <= 0.0)
    {
      towards[nearest] = std::copysign(1.0, point.x[nearest]);
      return keep(point, outside[nearest], towards);
    }
    for (int k = 0; k < 3; ++k)
      towards[k] = std::copysign(std::max(outside[k], 0.0), point.x[k]);
    const double length = towards.norm();
    keep(point, length, towards / length);
  }

  // A point is outside by at least its largest height above a face; inside, its depth is that.
  void add_hull(const Vector & point, const std::vector<Hull::Face> & faces)
  {
    const double limit = distance + radius_ + swept_;
    double largest = -std::numeric_limits<double>::infinity();
    std::size_t nearest = 0;
    for (std::size_t k = 0; k < faces.size(); ++k)
    {
      const Vector & n = faces[k].normal;
      const double height = n.x[0] * point.x[0] + n.x[1] * point.x[1] + n.x[2] * point.x[2] - faces[k].offset;
      if (height <= largest)
        continue;
      if (height >= limit)
        return;
      largest = height;
      nearest = k;
    }
    if (faces.empty() || largest > PLANE_ROUNDING)
      return candidates_.push_back({point, largest - radius_ - swept_});
    const Vector & n = faces[nearest].normal;
    keep(point, largest, coal::Vec3s(n.x[0], n.x[1], n.x[2]));
  }

  void query(const Vector & point)
  {
    result_.clear();
    const coal::Vec3s center(point.x[0], point.x[1], point.x[2]);
    const coal::Transform3s there(coal::Matrix3s::Identity(), center);
    const double value = signed_distance_of_solids(shape_, coal::Transform3s(), ball_, there, request_, result_);
    if (!(value < distance))
      return;
    found = true;
    distance = value;
    normal = result_.normal;
    first = result_.nearest_points[0];
    second = result_.nearest_points[1];
  }

  const coal::CollisionGeometry & shape_;
  coal::Sphere ball_;
  double radius_, swept_ = 0.0;
  const coal::DistanceRequest & request_;
  coal::DistanceResult result_;
  Vector center_, half_;
  std::vector<Candidate> candidates_;
};

// The signed distance of a shape, which must have its local box, to points. `bound` is returned
// instead of any larger distance, without witness points.
inline double distance_to_points(
  const coal::CollisionGeometry & shape,
  const coal::Transform3s & where,
  const Points & points,
  const coal::Transform3s & there,
  bool shape_is_first,
  double bound,
  const coal::DistanceRequest & request,
  coal::DistanceResult & result)
{
  if (is_points(shape))
    throw std::invalid_argument("distances between points and points are not computed");
  const coal::Transform3s relative = where.inverseTimes(there);
  Matrix turn;
  Vector shift;
  for (int i = 0; i < 3; ++i)
  {
    shift.x[i] = relative.getTranslation()[i];
    for (int j = 0; j < 3; ++j)
      turn.x[i][j] = relative.getRotation()(i, j);
  }
  const auto place = [&](const Vector & point) {
    Vector out = product(turn, point);
    for (int k = 0; k < 3; ++k)
      out.x[k] += shift.x[k];
    return out;
  };
  const Matrix extents = magnitudes(turn);
  NearestPoint nearest(shape, points.radius, bound, request);
  std::vector<std::pair<double, std::size_t>> order;
  for (std::size_t c = 0; c < points.cells.size(); ++c)
  {
    const Points::Cell & cell = points.cells[c];
    const double lower = nearest.bound_box(place(cell.center), product(extents, cell.half));
    if (lower < bound)
      order.emplace_back(lower, c);
  }
  std::sort(order.begin(), order.end());
  for (const auto & [lower, c] : order)
  {
    if (lower >= nearest.distance)
      break;
    nearest.add_cell(points, points.cells[c], place);
  }
  result.min_distance = nearest.distance;
  if (!nearest.found)
    return result.min_distance;
  const coal::Vec3s normal = where.getRotation() * nearest.normal;
  result.normal = shape_is_first ? normal : coal::Vec3s(-normal);
  result.nearest_points[shape_is_first ? 0 : 1] = where.transform(nearest.first);
  result.nearest_points[shape_is_first ? 1 : 0] = where.transform(nearest.second);
  return result.min_distance;
}

// The signed distance of two shapes. Distances to points of at least `bound` may be returned as
// `bound`.
inline double signed_distance(
  const coal::CollisionGeometry & one,
  const coal::Transform3s & where,
  const coal::CollisionGeometry & other,
  const coal::Transform3s & there,
  double bound,
  const coal::DistanceRequest & request,
  coal::DistanceResult & result)
{
  if (is_points(other))
    return distance_to_points(one, where, static_cast<const Points &>(other), there, true, bound, request, result);
  if (is_points(one))
    return distance_to_points(other, there, static_cast<const Points &>(one), where, false, bound, request, result);
  return signed_distance_of_solids(one, where, other, there, request, result);
}

} // namespace
