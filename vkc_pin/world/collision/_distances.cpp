// Python module: signed distances of many pairs of placed shapes at many states at once, computed
// by coal.
//
// A placement is twelve numbers: the columns of its rotation, then its translation.

#include <string>

#include <coal/config.hh>

#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "arrays.hpp"
#include "bodies.hpp"
#include "boxes.hpp"
#include "clearances.hpp"
#include "margins.hpp"
#include "points.hpp"
#include "shapes.hpp"
#include "solids.hpp"
#include "world_boxes.hpp"

NB_MODULE(_distances, module)
{
  module.doc() = "Signed distances of placed shapes, by coal, for many pairs at many states at once.";
  nb::set_leak_warnings(false); // caches and globals hold objects until the process ends
  module.attr("COAL_VERSION") = COAL_VERSION;
  module.attr("PINOCCHIO_VERSION") = vkc_pin::PINOCCHIO_RELEASE;
  nb::class_<Solid>(module, "Solid");
  module.def("primitive", &primitive);
  module.def("convex", &convex);
  module.def("mesh", &mesh);
  module.def("points", &points);
  nb::class_<Shapes>(module, "Shapes")
    .def(nb::init<const std::vector<Solid> &, const Numbers<2> &, double>())
    .def("placed", &Shapes::move_fixed)
    .def("distances", &Shapes::compute_distances)
    .def("shortest", &Shapes::find_closest_pairs);
  module.def("distance", &distance);
  module.def("near", &find_near_points);
  module.def("asked", [] { return query_count.load(); });
  nb::class_<Boxes>(module, "Boxes")
    .def(
      nb::init<
        const Indices<1> &, const Numbers<3> &, const Numbers<2> &, const Numbers<2> &, const Indices<2> &>())
    .def("placed", &Boxes::move_fixed);
  nb::class_<Bodies>(module, "Bodies")
    .def(
      "__init__",
      [](Bodies * self, const nb::bytes & model, const Indices<1> & joints, const Numbers<2> & placements) {
        if (placements.shape(0) != joints.shape(0) || placements.shape(1) != PLACEMENT)
          throw std::invalid_argument("placements are of shape (n, 12)");
        new (self) Bodies(std::string(model.c_str(), model.size()), joints.shape(0), joints.data(), placements.data());
      })
    .def("placements", &compute_placements)
    .def("jacobians", &compute_jacobians)
    .def("inverse_dynamics", &compute_inverse_dynamics);
  nb::class_<Margins>(module, "Margins")
    .def(nb::init<const Numbers<1> &>())
    .def("ease", &Margins::relax)
    .def("near", &Margins::add_region)
    .def("at", &Margins::compute_margins);
  nb::class_<WorldBoxes>(module, "WorldBoxes")
    .def(nb::init<const Numbers<3> &, const Numbers<3> &, const Numbers<2> &, const Numbers<2> &>())
    .def("near", &WorldBoxes::near);
  module.def("nearest", &find_closest_pairs);
  module.def("count_free", &count_free);
}
