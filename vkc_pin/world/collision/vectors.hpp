// Three-dimensional vectors and matrices. Sums are evaluated from left to right.
#pragma once

#include <cmath>

namespace {

struct Vector
{
  double x[3];
};

struct Matrix // row-major
{
  double x[3][3];
};

inline Vector product(const Matrix & m, const Vector & v)
{
  Vector out;
  for (int i = 0; i < 3; ++i)
    out.x[i] = m.x[i][0] * v.x[0] + m.x[i][1] * v.x[1] + m.x[i][2] * v.x[2];
  return out;
}

inline Vector product_transposed(const Matrix & m, const Vector & v)
{
  Vector out;
  for (int i = 0; i < 3; ++i)
    out.x[i] = m.x[0][i] * v.x[0] + m.x[1][i] * v.x[1] + m.x[2][i] * v.x[2];
  return out;
}

inline Matrix product(const Matrix & a, const Matrix & b)
{
  Matrix out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out.x[i][j] = a.x[i][0] * b.x[0][j] + a.x[i][1] * b.x[1][j] + a.x[i][2] * b.x[2][j];
  return out;
}

inline Matrix product_transposed(const Matrix & a, const Matrix & b)
{
  Matrix out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out.x[i][j] = a.x[0][i] * b.x[0][j] + a.x[1][i] * b.x[1][j] + a.x[2][i] * b.x[2][j];
  return out;
}

inline Matrix magnitudes(const Matrix & m)
{
  Matrix out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out.x[i][j] = std::abs(m.x[i][j]);
  return out;
}

inline Vector difference(const Vector & a, const Vector & b)
{
  return {{a.x[0] - b.x[0], a.x[1] - b.x[1], a.x[2] - b.x[2]}};
}

inline double square(const Vector & v)
{
  return v.x[0] * v.x[0] + v.x[1] * v.x[1] + v.x[2] * v.x[2];
}

inline Vector vector_at(const double * numbers)
{
  return {{numbers[0], numbers[1], numbers[2]}};
}

inline Matrix matrix_at(const double * numbers)
{
  Matrix out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out.x[i][j] = numbers[3 * i + j];
  return out;
}

} // namespace
