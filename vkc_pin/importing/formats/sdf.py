"""Reads SDF files (http://sdformat.org/spec), versions 1.2 to 1.12."""

from __future__ import annotations

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.description import (
    Coupling,
    Description,
    Joint,
    Limits,
    Link,
    MissingMesh,
    Part,
    make_inertia,
    make_limits,
)
from vkc_pin.importing.formats.sdf_scope import BASE, RULES, WORLD, Rules, Scope, is_true
from vkc_pin.utils.arrays import MAX_COORDINATE, MIN_POSITIVE
from vkc_pin.utils.system import is_file
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.gltf import GLTF_SUFFIXES
from vkc_pin.world.files.kinematic_tree import MOMENTS, find_roots
from vkc_pin.world.files.meshes import load_mesh
from vkc_pin.world.files.resources import find_mesh_file, iterate_address_candidates
from vkc_pin.world.files.xml import find_line, make_element_error, parse_xml

_NEWEST = 12  # minor version
_MOST_MODELS = 5000
# Of an <inertial> that does not state them, by the specification
_MASS = 1.0  # [kg]
_MOMENT = 1.0  # [kg·m²] about each axis
_DENSITY = 1000.0  # [kg/m³] of a shape whose inertia is computed
_DIAGONAL = ("ixx", "iyy", "izz")
_MOVING = ("revolute", "continuous", "prismatic")
_SIDES = 48  # facets of a cone
_JOINT_TYPES = ("fixed", *_MOVING, "ball", "universal", "revolute2", "screw", "gearbox")
# Elements of a <limit> and their defaults, by the specification; a rate of -1 means no limit
_LIMITS = {"lower": "-1e16", "upper": "1e16", "velocity": "-1", "effort": "-1"}
# Numbers of each shape: name of the element and count
_SHAPES = {
    "box": (("size", 3),),
    "cone": (("radius", 1), ("length", 1)),
    "sphere": (("radius", 1),),
    "cylinder": (("radius", 1), ("length", 1)),
    "capsule": (("radius", 1), ("length", 1)),
    "ellipsoid": (("radii", 3),),
}


def read_sdf_description(file: Path, packages: Mapping[str, Path]) -> Description:
    """Read the description of a robot, an object or a home from an SDF file.

    The root's frame is the world. Models that are neither static nor connected to the world stay in
    their places if they have joints, and are free otherwise, on floating joints.

    Args:
        file: The file, with one model or one world.
        packages: Folders of models by name; others are searched for around the file.
    """
    try:
        return _Reader(file, packages).read()
    except RecursionError:
        raise InputError("models or frames are nested too deeply", file=file) from None


class _Reader:
    def __init__(self, file: Path, packages: Mapping[str, Path]) -> None:
        self.file = file
        self.packages = packages
        self.count = 0  # of models
        self.notes = list[str]()
        self.missing = list[MissingMesh]()
        self.couplings = list[Coupling]()  # of joints by their full names
        root, rules = self._load(file)
        worlds, models = root.findall("world"), root.findall("model")
        if len(worlds) + len(models) != 1:
            got = f"{len(worlds)} worlds and {len(models)} models"
            raise InputError(
                "the SDF does not hold exactly one model",
                file=file,
                expected="<sdf> with one <model> or one <world>",
                got=got,
            )
        self.is_world = bool(worlds)
        self.root = worlds[0] if worlds else models[0]
        self.world = self._make_scope(
            Scope(file, worlds[0] if worlds else root, rules), (file.resolve(),)
        )

    def _load(self, file: Path) -> tuple[ElementTree.Element, Rules]:
        """Return the root of an SDF file and the rules of its version."""
        root = parse_xml(read_text(file, "SDF"), file)
        if root.tag != "sdf":
            expected = "an element <sdf>"
            raise InputError("this is no SDF", file=file, expected=expected, got=f"<{root.tag}>")
        if (
            raw := next((item for item in root.iter() if item.tag.startswith("xacro:")), None)
        ) is not None:
            expected, got = "a plain SDF: xacro FILE > model.sdf", f"<{raw.tag}>"
            raise make_element_error(
                file, raw, "xacro has not been run", expected=expected, got=got
            )
        text = root.get("version")
        match = re.fullmatch(
            r"\s*1\.(\d{1,3})(\.\d+)*\s*", f"1.{RULES[-1].since}" if text is None else text
        )
        if match is None or int(match[1]) < RULES[0].since:
            raise make_element_error(
                file,
                root,
                "not a version of SDF",
                field="sdf version",
                expected=f"1.{RULES[0].since} to 1.{_NEWEST}",
                got=f'"{text}"',
            )
        version = int(match[1])
        if text is None:
            self.notes.append(f"{file.name} states no version: read as SDF 1.{version}")
        if version > _NEWEST:
            self.notes.append(f"{file.name} has version 1.{version}: read as SDF 1.{_NEWEST}")
        rules = next(rules for rules in reversed(RULES) if rules.since <= version)
        self.notes += _note_other_versions(file, root, rules, version)
        return root, rules

    def _make_scope(self, scope: Scope, files: tuple[Path, ...]) -> Scope:
        """Fill in the elements of a model or world; `files` are those that include it."""
        self.count += 1
        if self.count > _MOST_MODELS:
            expected = f"at most {_MOST_MODELS}"
            raise InputError("too many models", file=self.file, expected=expected)
        for tag, elements in (
            ("link", scope.links),
            ("joint", scope.joints),
            ("frame", scope.frames),
        ):
            for element in scope.element.findall(tag):
                self._add(scope, elements, element, element)
        for element in scope.element.findall("model"):
            inner = Scope(scope.file, element, scope.rules, scope)
            self._add(scope, scope.models, element, inner)
            self._fill_inner_scope(inner, files)
        for include in scope.element.findall("include"):
            self._include(scope, include, files)
        for tag in ("actor", "population", "road", "state"):
            if scope.element.find(tag) is not None:
                self.notes.append(f"<{tag}> is left out")
        for name, inner in list(scope.models.items()):
            if inner.links or inner.models or inner.merged:
                continue
            if not self.is_world:
                problem = "a model without links"
                raise make_element_error(inner.file, inner.element, problem, field=name)
            self.notes.append(f"model '{name}' has no links: left out")
            del scope.models[name]
        return scope

    def _fill_inner_scope(
        self, inner: Scope, files: tuple[Path, ...], name: str | None = None
    ) -> None:
        """Fill in a model inside another one or a world; name "": its names are the other's."""
        assert inner.above is not None
        name = inner.element.get("name", "") if name is None else name
        is_only = inner.above.element.tag == "sdf"
        inner.path = inner.above.path + (f"{name}::" if name and not is_only else "")
        inner.active = inner.above.active
        self._make_scope(inner, files)

    def _add(
        self, scope: Scope, elements: dict[str, Any], element: ElementTree.Element, item: Any
    ) -> None:
        """Add an item by the name of an element, which must be unique."""
        name = (element.get("name") or element.findtext("name") or "").strip()
        if not name:
            problem, expected = f"a {element.tag} without a name", "a name"
            raise make_element_error(scope.file, element, problem, expected=expected)
        if name in elements:
            kind = "model" if element.tag == "include" else element.tag
            problem, expected = f"two {kind}s have the same name", f"a name for each {kind}"
            raise make_element_error(scope.file, element, problem, field=name, expected=expected)
        elements[name] = item

    def _include(self, scope: Scope, include: ElementTree.Element, files: tuple[Path, ...]) -> None:
        file = _find_model(scope.file, include, self.packages)
        if file.resolve() in files:
            got = " → ".join(item.name for item in (*files, file))
            raise make_element_error(scope.file, include, "a file includes itself", got=got)
        root, rules = self._load(file)
        models = root.findall("model")
        if not models and (root.find("light") is not None or root.find("actor") is not None):
            self.notes.append(f"{file.name} is left out: it holds no model")
            return
        if len(models) != 1:
            expected, got = "one <model>", f"{len(models)} models"
            raise InputError("not a model", file=file, expected=expected, got=got)
        inner = Scope(file, models[0], rules, scope, include=include)
        files = (*files, file.resolve())
        if is_true(include.get("merge", "false")):
            scope.merged.append(inner)
            self._fill_inner_scope(inner, files, "")
            return
        named = include if include.findtext("name") else models[0]
        self._add(scope, scope.models, named, inner)
        self._fill_inner_scope(
            inner, files, (named.findtext("name") or named.get("name") or "").strip()
        )

    def read(self) -> Description:
        """Return the description; see `read_sdf_description`."""
        scopes = list(self.world.walk())
        links: dict[str, tuple[Scope, str]] = {}
        for scope in scopes:
            for name, link in scope.links.items():
                if (key := scope.path + name) in links:
                    problem = "two links have the same name"
                    raise make_element_error(scope.file, link, problem, field=key)
                links[key] = scope, name
        if not links:
            got = ", ".join(f"<{tag}>" for tag in dict.fromkeys(item.tag for item in self.root))
            raise make_element_error(
                self.file,
                self.root,
                "a world without links",
                field=self.root.get("name"),
                expected="<model>s with <link>s",
                got=got or "nothing",
            )
        joints: dict[str, tuple[Scope, ElementTree.Element, str]] = {}  # by the child link
        for scope in scopes:
            for name, joint in scope.joints.items():
                kind = self._read_kind(scope, joint)
                if kind == "gearbox":
                    self.notes.append(f"joint '{name}' couples other joints: left out")
                    continue
                ends = [scope.find_link(scope.read_end(joint, key)) for key in ("parent", "child")]
                if ends[1] in joints:
                    problem, got = "a link with two parents", joints[ends[1]][1].get("name", "")
                    raise make_element_error(
                        scope.file,
                        joint,
                        problem,
                        field=ends[1],
                        expected="one joint",
                        got=f"joints '{got}' and '{name}'",
                    )
                joints[ends[1]] = scope, joint, ends[0]
        if BASE in joints:
            scope, joint, _ = joints[BASE]
            problem = "the world cannot be a child"
            raise make_element_error(scope.file, joint, problem, field=joint.get("name"))
        lines = {name: find_line(scope.links[local]) for name, (scope, local) in links.items()}
        is_connected = any(parent == BASE for _, _, parent in joints.values())
        above = {child: (parent, "") for child, (_, _, parent) in joints.items()}
        roots = find_roots(self.file, {**lines, **({BASE: None} if is_connected else {})}, above)
        return self._describe(links, joints, roots)

    def _describe(
        self,
        links: Mapping[str, tuple[Scope, str]],
        joints: Mapping[str, tuple[Scope, ElementTree.Element, str]],
        roots: Mapping[str, str],
    ) -> Description:
        kinds = self._connect(links, joints, roots)
        names = self._choose_names(links, kinds)
        base = names[BASE]
        repeated = Counter(joint.get("name", "") for _, joint, _ in joints.values())
        frames = {BASE: pin.SE3.Identity()}
        # Link frames are moved to their joints, so that axes pass through origins.
        for name, (scope, local) in links.items():
            if name in joints:
                holder, joint, _ = joints[name]
                frames[name] = holder.find_placement() * holder.find_joint_pose(joint)
            elif name in kinds:
                frames[name] = scope.find_placement(local)
            else:
                frames[name] = pin.SE3.Identity()
        found_links = {base: Link(base)} if kinds or BASE in roots else {}
        found_joints = dict[str, Joint]()
        for name, (scope, local) in links.items():
            found_links[names[name]] = self._read_link(scope, local, names[name], frames[name])
            if name in joints:
                holder, joint, parent = joints[name]
                label = str(joint.get("name"))
                label = holder.path + label if repeated[label] > 1 else label
                ends = (names[parent], names[name])
                found_joints[names[name]] = self._read_joint(
                    holder, joint, label, ends, frames[parent].inverse() * frames[name]
                )
            elif name in kinds:
                found_joints[names[name]] = Joint(
                    name=f"{names[name]}_{kinds[name]}",
                    kind=kinds[name],
                    parent=base,
                    child=names[name],
                    placement=frames[name],
                )
        labels = {
            holder.path + joint.get("name", ""): found_joints[names[child]].name
            for child, (holder, joint, _) in joints.items()
        }
        couplings = list[Coupling]()
        for coupling in self.couplings:
            leader = labels.get(coupling.leader or "", coupling.leader)
            couplings.append(
                dataclasses.replace(coupling, joint=labels[coupling.joint], leader=leader)
            )
        return Description(
            self.file,
            found_links,
            found_joints,
            notes=tuple(self.notes),
            missing=tuple(self.missing),
            format="SDF",
            couplings=tuple(couplings),
            is_world=base in found_links,
        )

    def _connect(
        self,
        links: Mapping[str, tuple[Scope, str]],
        joints: Mapping[str, tuple[Scope, ElementTree.Element, str]],
        roots: Mapping[str, str],
    ) -> dict[str, str]:
        """Return how each root that no joint connects is held in the world.

        Values are "fixed" and "floating". If the only root is to be the description's, there are
        none.
        """
        loose = [name for name in dict.fromkeys(roots.values()) if name != BASE]
        is_connected = BASE in roots
        if not self.is_world and len(loose) + is_connected == 1:
            return {}
        static = {roots[link] for link, (scope, _) in links.items() if scope.is_static}
        moving = {
            roots[child]
            for child, (scope, joint, _) in joints.items()
            if self._read_kind(scope, joint) in _MOVING
        }
        fixed = [name for name in loose if name in moving - static]
        if fixed:
            labels = [links[name][0].path.removesuffix("::") or name for name in fixed]
            about = "not static, but with joints, hence fixed in place"
            self.notes.append(f"{about}: {', '.join(labels)}")
        return {name: "fixed" if name in static | moving else "floating" for name in loose}

    def _choose_names(
        self, links: Mapping[str, tuple[Scope, str]], kinds: Mapping[str, str]
    ) -> dict[str, str]:
        """Return names of links; the only root of a model in a world is called like the model."""
        models = Counter(links[name][0].path for name in kinds)
        names = {name: name for name in links}
        for name in kinds:
            path = links[name][0].path
            if path and models[path] == 1 and path.removesuffix("::") not in links:
                names[name] = path.removesuffix("::")
        base = WORLD
        while base in names.values():
            base += "_"
        return {**names, BASE: base}

    def _read_kind(self, scope: Scope, joint: ElementTree.Element) -> str:
        kind, name = joint.get("type", "").strip(), joint.get("name")
        if kind not in _JOINT_TYPES:
            raise UnknownNameError(
                "joint type",
                kind,
                _JOINT_TYPES,
                file=scope.file,
                line=find_line(joint),
                field=name,
            )
        return kind

    def _read_joint(
        self,
        scope: Scope,
        joint: ElementTree.Element,
        name: str,
        ends: tuple[str, str],
        placement: pin.SE3,
    ) -> Joint:
        kind = self._read_kind(scope, joint)
        if kind not in ("fixed", *_MOVING):
            self.notes.append(f"joint '{name}' is {kind}: taken as fixed")
            kind = "fixed"
        axis, limits, settings = np.array([0.0, 0.0, 1.0]), None, dict[str, Any]()
        element = joint.find("axis")
        if element is not None and kind != "fixed":
            axis = self._read_axis(scope, joint, element)
            limits, velocity, effort = self._read_limits(scope, element, name)
            settings |= {"velocity": velocity, "effort": effort}
            settings |= self._read_dynamics(scope, element, name)
            mimic = element.find("mimic")
            if mimic is not None:
                self.couplings.append(self._read_mimic(scope, joint, mimic))
        return Joint(
            name=name,
            kind=kind,
            parent=ends[0],
            child=ends[1],
            placement=placement,
            axis=axis,
            limits=None if kind == "continuous" else limits,
            **settings,
        )

    def _read_mimic(
        self, scope: Scope, joint: ElementTree.Element, mimic: ElementTree.Element
    ) -> Coupling:
        """Return the coupling y = factor · (x − reference) + offset of a joint, by full names."""
        name = joint.get("name", "")
        (factor,) = scope.read_numbers(mimic, "multiplier", 1, "1", name)
        (offset,) = scope.read_numbers(mimic, "offset", 1, "0", name)
        (reference,) = scope.read_numbers(mimic, "reference", 1, "0", name)
        leader = scope.path + mimic.get("joint", "").strip()
        coefficients = (offset - factor * reference, factor)
        return Coupling(scope.path + name, leader, coefficients, "<mimic>")

    def _read_axis(
        self, scope: Scope, joint: ElementTree.Element, element: ElementTree.Element
    ) -> Any:
        """Return the unit axis in the joint's frame, shape (3,)."""
        name, xyz = joint.get("name", ""), element.find("xyz")
        axis = np.array(scope.read_numbers(element, "xyz", 3, "0 0 1", name))
        if not np.linalg.norm(axis) > 0.0:
            problem, got = "an axis without direction", (element.findtext("xyz") or "").strip()
            field_ = f"{name}: axis xyz"
            raise make_element_error(scope.file, element, problem, field=field_, got=got)
        own = scope.find_joint_pose(joint)
        stated = "" if xyz is None else xyz.get("expressed_in", "").strip()
        if stated:
            frame = scope.find_pose(stated)
        elif scope.rules.axis_frame is None or (
            scope.rules.axis_frame == "use_parent_model_frame"
            and is_true(element.findtext("use_parent_model_frame") or "")
        ):
            frame = scope.find_pose("__model__")
        else:
            frame = own
        axis = own.rotation.T @ frame.rotation @ axis
        return axis / np.linalg.norm(axis)

    def _read_limits(
        self, scope: Scope, element: ElementTree.Element, name: str
    ) -> tuple[Limits, float | None, float | None]:
        """Return the position, velocity and effort limits of an axis."""
        limit = element.find("limit")
        if limit is None:
            return make_limits(-math.inf, math.inf), None, None
        low, high, velocity, effort = (
            scope.read_numbers(limit, key, 1, default, name, largest=math.inf, is_finite=False)[0]
            for key, default in _LIMITS.items()
        )
        if low > high:
            ends = f"{low:g} and {high:g}"
            self.notes.append(
                f"joint '{name}' has a lower limit above its upper limit, {ends}: swapped"
            )
            low, high = high, low
        rates = [
            rate if MIN_POSITIVE <= rate < MAX_COORDINATE else None for rate in (velocity, effort)
        ]
        return make_limits(low, high), rates[0], rates[1]

    def _read_dynamics(
        self, scope: Scope, element: ElementTree.Element, name: str
    ) -> dict[str, float]:
        if (dynamics := element.find("dynamics")) is None:
            return {}
        damping, friction, stiffness, rest = (
            scope.read_numbers(dynamics, key, 1, "0", name, largest=math.inf, is_finite=False)[0]
            for key in ("damping", "friction", "spring_stiffness", "spring_reference")
        )
        return {
            "damping": damping,
            "friction": friction,
            "stiffness": stiffness,
            "springref": rest,
        }

    def _read_link(self, scope: Scope, local: str, name: str, frame: pin.SE3) -> Link:
        element = scope.links[local]
        # Places elements in the link's new frame.
        base = frame.inverse() * scope.find_placement()
        lost: dict[str, list[InputError]] = {"visual": [], "collision": []}
        visual, collision = (
            tuple(self._read_shapes(scope, element, kind, base, local, errors))
            for kind, errors in lost.items()
        )
        inertia = self._read_inertia(scope, element, base, local, collision)
        if lost["collision"] and visual:
            collision, about = (), "its visual shapes collide instead"
            self.notes += [f"link '{local}': {error}: {about}" for error in lost["collision"]]
        elif lost["collision"] or (lost["visual"] and not visual and not collision):
            lost_kind = "collision" if lost["collision"] else "visual"
            self.missing += [MissingMesh(name, lost_kind, error) for error in lost[lost_kind]]
        self.notes += [f"link '{local}': {error}: left out" for error in lost["visual"]]
        return Link(name, visual, collision, inertia)

    def _read_shapes(
        self,
        scope: Scope,
        link: ElementTree.Element,
        kind: str,
        base: pin.SE3,
        local: str,
        lost: list[InputError],
    ) -> Iterator[Part]:
        """Yield the shapes of a link, and add errors about missing meshes to `lost`."""
        for element in link.findall(kind):
            name, geometry = element.get("name", ""), element.find("geometry")
            shape = next(iter(geometry), None) if geometry is not None else None
            if shape is None or shape.tag not in (*_SHAPES, "mesh"):
                content = "empty" if shape is None else shape.tag
                self.notes.append(f"{kind} '{name}' of link '{local}' is {content}: left out")
                continue
            file = None
            if shape.tag == "mesh":
                uri, line = (shape.findtext("uri") or "").strip(), find_line(shape)
                try:
                    file = find_mesh_file(uri, scope.file, self.packages, line=line)
                except InputError as error:
                    lost.append(error)
                    continue
            yield Part(
                name=name,
                placement=base * scope.read_pose(element, local),
                colour=self._read_colour(scope, element, name),
                **self._read_geometry(scope, shape, name, file),
            )

    def _read_geometry(
        self, scope: Scope, shape: ElementTree.Element, name: str, file: Path | None
    ) -> dict[str, Any]:
        """Return kind, size, file and triangles of a shape."""
        if file is not None:
            if file.suffix.lower() in GLTF_SUFFIXES:
                turned = "is turned from y up, as glTF specifies, to z up, unlike in Gazebo"
                self.notes.append(f"{file.name} {turned}")
            size = scope.read_numbers(shape, "scale", 3, "1 1 1", name)
            part = shape.find("submesh")
            if part is None:
                return {"kind": "mesh", "size": size, "file": file}
            mesh = load_mesh(file, submesh=(part.findtext("name") or "").strip())
            if is_true(part.findtext("center") or ""):
                mesh.apply_translation(-mesh.bounds.mean(axis=0))
            return {"kind": "mesh", "size": size, "triangles": mesh}
        size = tuple(
            value
            for key, count in _SHAPES[shape.tag]
            for value in scope.read_numbers(shape, key, count, None, name)
        )
        if min(size) <= 0.0:
            problem, expected = "a shape without volume", "sizes above 0"
            raise make_element_error(
                scope.file, shape, problem, field=name, expected=expected, got=size
            )
        import trimesh

        if shape.tag == "cone":
            radius, length = size
            # Its frame is at half of its height, the tip on z.
            cone = trimesh.creation.cone(radius, length, sections=_SIDES)
            cone.apply_translation((0.0, 0.0, -0.5 * length))
            return {"kind": "mesh", "size": (1.0, 1.0, 1.0), "triangles": cone}
        if shape.tag == "ellipsoid":
            ball = trimesh.creation.icosphere(subdivisions=3)
            return {"kind": "mesh", "size": size, "triangles": ball}
        return {"kind": shape.tag, "size": size}

    def _read_inertia(
        self,
        scope: Scope,
        link: ElementTree.Element,
        base: pin.SE3,
        local: str,
        collision: Sequence[Part],
    ) -> pin.Inertia:
        """Return a link's inertia; a wrong <inertial> counts as none, with a note.

        Values that an <inertial> leaves out have the defaults of the specification.
        """
        element = link.find("inertial")
        if element is None:
            return pin.Inertia.Zero()
        try:
            if is_true(element.get("auto", "")):
                return self._compute_inertia(scope, link, element, local, collision)
            (mass,) = scope.read_numbers(element, "mass", 1, f"{_MASS}", local)
            moments = element.find("inertia")
            if moments is None:
                moments = ElementTree.Element("inertia")
                stated = f"states no <inertia>: {_MOMENT:g} kg·m² about each axis, as in Gazebo"
                self.notes.append(f"link '{local}': its <inertial> {stated}")
            entries = [
                scope.read_numbers(moments, key, 1, f"{_MOMENT if key in _DIAGONAL else 0}", local)
                for key in MOMENTS
            ]
            values = (value for (value,) in entries)
            return make_inertia(mass, values, base * scope.read_pose(element, local))
        except InputError as error:
            self.notes.append(f"link '{local}': {error}: its <inertial> counts as none")
            return pin.Inertia.Zero()

    def _compute_inertia(
        self,
        scope: Scope,
        link: ElementTree.Element,
        inertial: ElementTree.Element,
        local: str,
        collision: Sequence[Part],
    ) -> pin.Inertia:
        """Return the inertia of a link's collision shapes as solids, with the mass it states.

        A shape has its own density, else that of the <inertial>, else that of water, as in
        libsdformat, which scales the sum to a stated mass from its version 15.2 on.
        """
        (common,) = scope.read_numbers(
            inertial, "density", 1, f"{_DENSITY}", local, largest=math.inf
        )
        densities = dict[str, float]()
        for element in link.findall("collision"):
            (density,) = scope.read_numbers(
                element, "density", 1, f"{common!r}", local, largest=math.inf
            )
            densities[element.get("name", "")] = density
        total = pin.Inertia.Zero()
        for part in collision:
            total += part.compute_inertia(densities[part.name])
        if not total.mass > 0.0:
            problem = "its mass cannot be computed from its collision shapes"
            raise InputError(problem, field=local, expected="solids", got=f"{total.mass:g} kg")
        if inertial.find("mass") is not None:
            (mass,) = scope.read_numbers(inertial, "mass", 1, None, local)
            tensor = np.asarray(total.inertia) * mass / total.mass
            total = pin.Inertia(mass, total.lever, tensor)
        return total

    def _read_colour(
        self, scope: Scope, element: ElementTree.Element, name: str
    ) -> tuple[float, float, float, float] | None:
        material = element.find("material")
        if material is None or material.find("diffuse") is None:
            return None
        rgba = (material.findtext("diffuse") or "").split()
        values = scope.read_numbers(material, "diffuse", len(rgba), "", name)
        red, green, blue, opacity = (*values, 1.0)[:4] if len(values) >= 3 else (0.8, 0.8, 0.8, 1.0)
        return red, green, blue, opacity


def _note_other_versions(
    file: Path, root: ElementTree.Element, rules: Rules, version: int
) -> Iterator[str]:
    """Yield a note about each setting that another version has, and that would matter there."""
    for element in root.iter():
        name = None
        if element.tag == "use_parent_model_frame" and rules.axis_frame != element.tag:
            # Up to 1.4 axes are in the model's frame, from 1.7 on in the joint's.
            is_other = is_true(element.text or "") == (rules.axis_frame is not None)
            name = f"<{element.tag}>" if is_other else None
        elif element.tag == "pose" and rules.pose_frame != "frame" and element.get("frame"):
            name = "`frame` of <pose>"
        if name is not None:
            where = f"{file.name}:{find_line(element)}"
            yield f"{where}: {name} does not belong to SDF 1.{version}: left out"


def _find_model(file: Path, include: ElementTree.Element, packages: Mapping[str, Path]) -> Path:
    """Return the SDF file that an <include> names, in a model's folder as its model.config says."""
    uri = (include.findtext("uri") or "").strip()
    candidates = iterate_address_candidates(uri, file, packages) if uri else []
    for candidate in candidates:
        if is_file(candidate):
            return candidate
        if is_file(candidate / "model.config"):
            config = candidate / "model.config"
            root = parse_xml(read_text(config, "model.config"), config)
            stated = {
                int(match[1]): (element.text or "").strip()
                for element in root.findall("sdf")
                if (match := re.match(r"\s*1\.(\d{1,3})", element.get("version", "1.0")))
            }
            known = [version for version in stated if version <= _NEWEST] or list(stated)
            if known and is_file(candidate / stated[max(known)]):
                return candidate / stated[max(known)]
        if is_file(candidate / "model.sdf"):
            return candidate / "model.sdf"
    raise make_element_error(
        file,
        include,
        "there is no such model",
        field="include uri",
        expected="a folder with a model.sdf around the file or in GZ_SIM_RESOURCE_PATH",
        got=uri or "none",
    )
