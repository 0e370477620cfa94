// Creates shapes from their dimensions, or from points and faces, with their local boxes.
#pragma once

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <coal/BVH/BVH_model.h>
#include <coal/shape/convex.h>
#include <coal/shape/geometric_shapes.h>

#include "arrays.hpp"
#include "points.hpp"

namespace {

struct Solid
{
  std::shared_ptr<coal::CollisionGeometry> geometry;
};

coal::Vec3s vector(const std::vector<double> & numbers, std::size_t first)
{
  return coal::Vec3s(numbers.at(first), numbers.at(first + 1), numbers.at(first + 2));
}

// Lengths are half-lengths, as coal stores them; doubling and halving them is exact.
Solid primitive(const std::string & kind, const std::vector<double> & numbers, double swept_sphere_radius)
{
  std::shared_ptr<coal::ShapeBase> shape;
  if (kind == "Box")
    shape = std::make_shared<coal::Box>(2.0 * vector(numbers, 0));
  else if (kind == "Sphere")
    shape = std::make_shared<coal::Sphere>(numbers.at(0));
  else if (kind == "Ellipsoid")
    shape = std::make_shared<coal::Ellipsoid>(vector(numbers, 0));
  else if (kind == "Capsule")
    shape = std::make_shared<coal::Capsule>(numbers.at(0), 2.0 * numbers.at(1));
  else if (kind == "Cone")
    shape = std::make_shared<coal::Cone>(numbers.at(0), 2.0 * numbers.at(1));
  else if (kind == "Cylinder")
    shape = std::make_shared<coal::Cylinder>(numbers.at(0), 2.0 * numbers.at(1));
  else if (kind == "TriangleP")
    shape = std::make_shared<coal::TriangleP>(vector(numbers, 0), vector(numbers, 3), vector(numbers, 6));
  else if (kind == "Halfspace")
  {
    auto space = std::make_shared<coal::Halfspace>(vector(numbers, 0), numbers.at(3));
    space->n = vector(numbers, 0); // unchanged: normalizing it again could change its last digits
    space->d = numbers.at(3);
    shape = space;
  }
  else if (kind == "Plane")
  {
    auto plane = std::make_shared<coal::Plane>(vector(numbers, 0), numbers.at(3));
    plane->n = vector(numbers, 0);
    plane->d = numbers.at(3);
    shape = plane;
  }
  else
    throw std::invalid_argument("unknown kind of shape: " + kind);
  shape->setSweptSphereRadius(swept_sphere_radius);
  shape->computeLocalAABB();
  return {shape};
}

std::vector<coal::Vec3s> to_corners(const Numbers<2> & points)
{
  if (points.shape(1) != 3)
    throw std::invalid_argument("points are of shape (n, 3)");
  std::vector<coal::Vec3s> corners;
  corners.reserve(points.shape(0));
  for (std::size_t i = 0; i < points.shape(0); ++i)
    corners.emplace_back(points(i, 0), points(i, 1), points(i, 2));
  return corners;
}

std::vector<coal::Triangle> to_triangles(const Indices<2> & faces, std::size_t points)
{
  if (faces.shape(1) != 3)
    throw std::invalid_argument("faces are of shape (m, 3)");
  std::vector<coal::Triangle> triangles;
  triangles.reserve(faces.shape(0));
  for (std::size_t i = 0; i < faces.shape(0); ++i)
  {
    for (std::size_t k = 0; k < 3; ++k)
      if (faces(i, k) < 0 || std::size_t(faces(i, k)) >= points)
        throw std::out_of_range("a face has a corner that is none of the points");
    using Corner = coal::Triangle::index_type;
    triangles.emplace_back(Corner(faces(i, 0)), Corner(faces(i, 1)), Corner(faces(i, 2)));
  }
  return triangles;
}

Solid convex(const Numbers<2> & points, const Indices<2> & faces, double swept_sphere_radius)
{
  auto corners = std::make_shared<std::vector<coal::Vec3s>>(to_corners(points));
  auto triangles = std::make_shared<std::vector<coal::Triangle>>(to_triangles(faces, corners->size()));
  auto shape = std::make_shared<Hull>(corners, triangles);
  shape->setSweptSphereRadius(swept_sphere_radius);
  shape->computeLocalAABB();
  return {shape};
}

Solid mesh(const Numbers<2> & points, const Indices<2> & faces)
{
  const auto corners = to_corners(points);
  const auto triangles = to_triangles(faces, corners.size());
  auto model = std::make_shared<coal::BVHModel<coal::OBBRSS>>();
  model->beginModel(unsigned(triangles.size()), unsigned(corners.size()));
  model->addSubModel(corners, triangles);
  model->endModel();
  model->computeLocalAABB();
  return {model};
}

Solid points(const Numbers<2> & centers, double radius)
{
  return {std::make_shared<Points>(centers, radius)};
}

} // namespace
