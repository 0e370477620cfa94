"""Reads SDF files (http://sdformat.org/spec), versions 1.2 to 1.12."""

from __future__ import annotations

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.description import (
    MOVING_KINDS,
    Colour,
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
_GREY: Colour = (0.8, 0.8, 0.8, 1.0)  # of a shape whose <diffuse> has less than three numbers
_SIDES = 48  # facets of a cone
_JOINT_TYPES = ("fixed", *MOVING_KINDS, "ball", "universal", "revolute2", "screw", "gearbox")
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


class _SdfLink(NamedTuple):
    """A link: the model that defines it, and its name there."""

    scope: Scope
    local: str


class _SdfJoint(NamedTuple):
    """A joint: the model that defines it, its element, and the full name of its parent link."""

    scope: Scope
    element: ElementTree.Element
    parent: str

    @property
    def name(self) -> str:
        """Name in its model."""
        return _get_name(self.element)


class _Reader:
    def __init__(self, file: Path, packages: Mapping[str, Path]) -> None:
        self.file = file
        self.packages = packages
        self.count = 0  # of models
        self.notes = list[str]()
        self.missing = list[MissingMesh]()
        self.couplings = list[Coupling]()  # of joints by their full names
        root, rules = self._load(file)
        worlds = root.findall("world")
        models = root.findall("model")
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
        world = Scope(file, worlds[0] if worlds else root, rules)
        self.world = self._make_scope(world, (file.resolve(),))

    def _load(self, file: Path) -> tuple[ElementTree.Element, Rules]:
        """Return the root of an SDF file and the rules of its version."""
        root = parse_xml(read_text(file, "SDF"), file)
        if root.tag != "sdf":
            expected = "an element <sdf>"
            raise InputError("this is no SDF", file=file, expected=expected, got=f"<{root.tag}>")
        for element in root.iter():
            if element.tag.startswith("xacro:"):
                raise make_element_error(
                    file,
                    element,
                    "xacro has not been run",
                    expected="a plain SDF: xacro FILE > model.sdf",
                    got=f"<{element.tag}>",
                )
        version = self._read_version(file, root)
        rules = RULES[0]
        for later in RULES:
            if later.since <= version:
                rules = later
        self.notes += _note_other_versions(file, root, rules, version)
        return root, rules

    def _read_version(self, file: Path, root: ElementTree.Element) -> int:
        """Return the minor version of an SDF file, with a note if it is missing or unknown."""
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
        return version

    # Models

    def _make_scope(self, scope: Scope, files: tuple[Path, ...]) -> Scope:
        """Fill in the elements of a model or world; `files` are those that include it."""
        self.count += 1
        if self.count > _MOST_MODELS:
            expected = f"at most {_MOST_MODELS}"
            raise InputError("too many models", file=self.file, expected=expected)
        named_elements = {"link": scope.links, "joint": scope.joints, "frame": scope.frames}
        for tag, elements in named_elements.items():
            for element in scope.element.findall(tag):
                self._add(scope, elements, element, element)
        for element in scope.element.findall("model"):
            inner = Scope(scope.file, element, scope.rules, scope)
            self._add(scope, scope.models, element, inner)
            self._fill_inner_scope(inner, files, _get_name(element))
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

    def _fill_inner_scope(self, inner: Scope, files: tuple[Path, ...], name: str) -> None:
        """Fill in a model inside another one or a world; name "": its names are the other's."""
        above = inner.above
        assert above is not None
        inner.path = above.path
        # The only model of a file is the description itself: its names need no prefix.
        if name and above.element.tag != "sdf":
            inner.path += f"{name}::"
        inner.active = above.active
        self._make_scope(inner, files)

    def _add(
        self, scope: Scope, elements: dict[str, Any], element: ElementTree.Element, item: Any
    ) -> None:
        """Add an item by the name of an element, which must be unique."""
        name = _get_name(element)
        if not name:
            problem = f"a {element.tag} without a name"
            raise make_element_error(scope.file, element, problem, expected="a name")
        if name in elements:
            kind = "model" if element.tag == "include" else element.tag
            problem = f"two {kind}s have the same name"
            expected = f"a name for each {kind}"
            raise make_element_error(scope.file, element, problem, field=name, expected=expected)
        elements[name] = item

    def _include(self, scope: Scope, include: ElementTree.Element, files: tuple[Path, ...]) -> None:
        """Add the model of another file, which <include> may rename or merge with this one."""
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
            got = f"{len(models)} models"
            raise InputError("not a model", file=file, expected="one <model>", got=got)
        inner = Scope(file, models[0], rules, scope, include=include)
        files = (*files, file.resolve())
        if is_true(include.get("merge", "false")):
            scope.merged.append(inner)
            self._fill_inner_scope(inner, files, "")
            return
        named = include if include.findtext("name") else models[0]
        self._add(scope, scope.models, named, inner)
        self._fill_inner_scope(inner, files, _get_name(named))

    # The tree

    def read(self) -> Description:
        """Return the description; see `read_sdf_description`."""
        scopes = list(self.world.walk())
        links = self._collect_links(scopes)
        joints = self._collect_joints(scopes)
        lines: dict[str, int | None] = {
            name: find_line(link.scope.links[link.local]) for name, link in links.items()
        }
        if any(joint.parent == BASE for joint in joints.values()):
            lines[BASE] = None
        above = {child: (joint.parent, "") for child, joint in joints.items()}
        roots = find_roots(self.file, lines, above)
        return self._describe(links, joints, roots)

    def _collect_links(self, scopes: Sequence[Scope]) -> dict[str, _SdfLink]:
        """Return the links of all models by their full names."""
        links = dict[str, _SdfLink]()
        for scope in scopes:
            for local, link in scope.links.items():
                name = scope.path + local
                if name in links:
                    problem = "two links have the same name"
                    raise make_element_error(scope.file, link, problem, field=name)
                links[name] = _SdfLink(scope, local)
        if not links:
            tags = dict.fromkeys(item.tag for item in self.root)
            got = ", ".join(f"<{tag}>" for tag in tags)
            raise make_element_error(
                self.file,
                self.root,
                "a world without links",
                field=self.root.get("name"),
                expected="<model>s with <link>s",
                got=got or "nothing",
            )
        return links

    def _collect_joints(self, scopes: Sequence[Scope]) -> dict[str, _SdfJoint]:
        """Return the joints of all models by the full names of their child links."""
        joints = dict[str, _SdfJoint]()
        for scope in scopes:
            for name, element in scope.joints.items():
                if self._read_kind(scope, element) == "gearbox":
                    self.notes.append(f"joint '{name}' couples other joints: left out")
                    continue
                parent = scope.find_link(scope.read_end(element, "parent"))
                child = scope.find_link(scope.read_end(element, "child"))
                if child in joints:
                    raise make_element_error(
                        scope.file,
                        element,
                        "a link with two parents",
                        field=child,
                        expected="one joint",
                        got=f"joints '{joints[child].name}' and '{name}'",
                    )
                joints[child] = _SdfJoint(scope, element, parent)
        if BASE in joints:
            joint = joints[BASE]
            problem = "the world cannot be a child"
            field = joint.element.get("name")
            raise make_element_error(joint.scope.file, joint.element, problem, field=field)
        return joints

    def _describe(
        self,
        links: Mapping[str, _SdfLink],
        joints: Mapping[str, _SdfJoint],
        roots: Mapping[str, str],
    ) -> Description:
        """Return the description of links by full names, and joints by those of their children."""
        kinds = self._connect(links, joints, roots)
        names = self._choose_names(links, kinds)
        labels = self._choose_joint_names(joints)
        frames = self._place_links(links, joints, kinds)
        base = names[BASE]
        found_links = dict[str, Link]()
        if kinds or BASE in roots:
            found_links[base] = Link(base)
        found_joints = dict[str, Joint]()
        for key, link in links.items():
            name = names[key]
            found_links[name] = self._read_link(link.scope, link.local, name, frames[key])
            if key in joints:
                joint = joints[key]
                ends = (names[joint.parent], name)
                placement = frames[joint.parent].inverse() * frames[key]
                found_joints[name] = self._read_joint(
                    joint.scope, joint.element, labels[key], ends, placement
                )
            elif key in kinds:
                found_joints[name] = Joint(
                    name=f"{name}_{kinds[key]}",
                    kind=kinds[key],
                    parent=base,
                    child=name,
                    placement=frames[key],
                )
        couplings = self._rename_couplings(joints, labels)
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
        links: Mapping[str, _SdfLink],
        joints: Mapping[str, _SdfJoint],
        roots: Mapping[str, str],
    ) -> dict[str, str]:
        """Return how each root that no joint connects is held in the world.

        Values are "fixed" and "floating". If the only root is to be the description's, there are
        none.
        """
        distinct = list(dict.fromkeys(roots.values()))
        if not self.is_world and len(distinct) == 1:
            return {}
        loose = [name for name in distinct if name != BASE]
        static = {roots[key] for key, link in links.items() if link.scope.is_static}
        moving = set[str]()
        for child, joint in joints.items():
            if self._read_kind(joint.scope, joint.element) in MOVING_KINDS:
                moving.add(roots[child])
        fixed = [name for name in loose if name in moving - static]
        if fixed:
            labels = [links[name].scope.path.removesuffix("::") or name for name in fixed]
            about = "not static, but with joints, hence fixed in place"
            self.notes.append(f"{about}: {', '.join(labels)}")
        return {name: "fixed" if name in static | moving else "floating" for name in loose}

    def _choose_names(
        self, links: Mapping[str, _SdfLink], kinds: Mapping[str, str]
    ) -> dict[str, str]:
        """Return names of links; the only root of a model in a world is called like the model."""
        models = Counter(links[key].scope.path for key in kinds)
        names = {key: key for key in links}
        for key in kinds:
            path = links[key].scope.path
            model = path.removesuffix("::")
            if path and models[path] == 1 and model not in links:
                names[key] = model
        base = WORLD
        while base in names.values():
            base += "_"
        names[BASE] = base
        return names

    def _choose_joint_names(self, joints: Mapping[str, _SdfJoint]) -> dict[str, str]:
        """Return the names of joints by their child links, full ones where models share a name."""
        counts = Counter(joint.name for joint in joints.values())
        names = dict[str, str]()
        for child, joint in joints.items():
            is_unique = counts[joint.name] == 1
            names[child] = joint.name if is_unique else joint.scope.path + joint.name
        return names

    def _place_links(
        self,
        links: Mapping[str, _SdfLink],
        joints: Mapping[str, _SdfJoint],
        kinds: Mapping[str, str],
    ) -> dict[str, pin.SE3]:
        """Return the frames of links in the world.

        They are moved to the links' joints, so that axes pass through origins.
        """
        frames = {BASE: pin.SE3.Identity()}
        for key, link in links.items():
            if key in joints:
                joint = joints[key]
                pose = joint.scope.find_joint_pose(joint.element)
                frames[key] = joint.scope.find_placement() * pose
            elif key in kinds:
                frames[key] = link.scope.find_placement(link.local)
            else:
                frames[key] = pin.SE3.Identity()
        return frames

    def _rename_couplings(
        self, joints: Mapping[str, _SdfJoint], labels: Mapping[str, str]
    ) -> list[Coupling]:
        """Return the couplings with the names of joints in the description."""
        names = {joint.scope.path + joint.name: labels[child] for child, joint in joints.items()}
        couplings = list[Coupling]()
        for coupling in self.couplings:
            leader = names.get(coupling.leader or "", coupling.leader)
            couplings.append(
                dataclasses.replace(coupling, joint=names[coupling.joint], leader=leader)
            )
        return couplings

    # Joints

    def _read_kind(self, scope: Scope, joint: ElementTree.Element) -> str:
        kind = joint.get("type", "").strip()
        if kind not in _JOINT_TYPES:
            raise UnknownNameError(
                "joint type",
                kind,
                _JOINT_TYPES,
                file=scope.file,
                line=find_line(joint),
                field=joint.get("name"),
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
        if kind not in ("fixed", *MOVING_KINDS):
            self.notes.append(f"joint '{name}' is {kind}: taken as fixed")
            kind = "fixed"
        parent, child = ends
        element = joint.find("axis")
        if element is None or kind == "fixed":
            return Joint(
                name=name,
                kind=kind,
                parent=parent,
                child=child,
                placement=placement,
                axis=np.array([0.0, 0.0, 1.0]),
            )
        axis = self._read_axis(scope, joint, element)
        limits, velocity, effort = self._read_limits(scope, element, name)
        dynamics = self._read_dynamics(scope, element, name)
        mimic = element.find("mimic")
        if mimic is not None:
            self.couplings.append(self._read_mimic(scope, joint, mimic))
        return Joint(
            name=name,
            kind=kind,
            parent=parent,
            child=child,
            placement=placement,
            axis=axis,
            limits=None if kind == "continuous" else limits,
            velocity=velocity,
            effort=effort,
            **dynamics,
        )

    def _read_mimic(
        self, scope: Scope, joint: ElementTree.Element, mimic: ElementTree.Element
    ) -> Coupling:
        """Return the coupling y = factor · (x − reference) + offset of a joint, by full names."""
        name = _get_name(joint)
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
        name = _get_name(joint)
        xyz = element.find("xyz")
        axis = np.array(scope.read_numbers(element, "xyz", 3, "0 0 1", name))
        if not np.linalg.norm(axis) > 0.0:
            raise make_element_error(
                scope.file,
                element,
                "an axis without direction",
                field=f"{name}: axis xyz",
                got=(element.findtext("xyz") or "").strip(),
            )
        own = scope.find_joint_pose(joint)
        # The frame in which the numbers are: one that is named, the model's, or the joint's.
        stated = "" if xyz is None else xyz.get("expressed_in", "").strip()
        axis_frame = scope.rules.axis_frame
        in_model = axis_frame is None
        if axis_frame == "use_parent_model_frame":
            in_model = is_true(element.findtext(axis_frame) or "")
        if stated:
            frame = scope.find_pose(stated)
        elif in_model:
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
        numbers = {
            key: _read_any_number(scope, limit, key, default, name)
            for key, default in _LIMITS.items()
        }
        low = numbers["lower"]
        high = numbers["upper"]
        if low > high:
            ends = f"{low:g} and {high:g}"
            self.notes.append(
                f"joint '{name}' has a lower limit above its upper limit, {ends}: swapped"
            )
            low, high = high, low
        velocity = _read_rate_limit(numbers["velocity"])
        effort = _read_rate_limit(numbers["effort"])
        return make_limits(low, high), velocity, effort

    def _read_dynamics(
        self, scope: Scope, element: ElementTree.Element, name: str
    ) -> dict[str, Any]:
        """Return resistances and spring of an axis by the names of attributes of `Joint`."""
        dynamics = element.find("dynamics")
        if dynamics is None:
            return {}
        return {
            "damping": _read_any_number(scope, dynamics, "damping", "0", name),
            "friction": _read_any_number(scope, dynamics, "friction", "0", name),
            "stiffness": _read_any_number(scope, dynamics, "spring_stiffness", "0", name),
            "springref": _read_any_number(scope, dynamics, "spring_reference", "0", name),
        }

    # Links

    def _read_link(self, scope: Scope, local: str, name: str, frame: pin.SE3) -> Link:
        element = scope.links[local]
        # Places elements in the link's new frame.
        base = frame.inverse() * scope.find_placement()
        lost_visual = list[InputError]()
        lost_collision = list[InputError]()
        visual = tuple(self._read_shapes(scope, element, "visual", base, local, lost_visual))
        collision = tuple(
            self._read_shapes(scope, element, "collision", base, local, lost_collision)
        )
        inertia = self._read_inertia(scope, element, base, local, collision)
        if lost_collision and visual:
            collision = ()
            about = "its visual shapes collide instead"
            self.notes += [f"link '{local}': {error}: {about}" for error in lost_collision]
        elif lost_collision:
            self.missing += [MissingMesh(name, "collision", error) for error in lost_collision]
        elif not visual and not collision:
            self.missing += [MissingMesh(name, "visual", error) for error in lost_visual]
        self.notes += [f"link '{local}': {error}: left out" for error in lost_visual]
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
            name = element.get("name", "")
            geometry = element.find("geometry")
            shape = None if geometry is None else geometry.find("*")
            if shape is None or shape.tag not in (*_SHAPES, "mesh"):
                content = "empty" if shape is None else shape.tag
                self.notes.append(f"{kind} '{name}' of link '{local}' is {content}: left out")
                continue
            file = None
            if shape.tag == "mesh":
                uri = (shape.findtext("uri") or "").strip()
                try:
                    file = find_mesh_file(uri, scope.file, self.packages, line=find_line(shape))
                except InputError as error:
                    lost.append(error)
                    continue
            placement = base * scope.read_pose(element, local)
            colour = self._read_colour(scope, element, name)
            form = self._read_geometry(scope, shape, name, file)
            yield Part(name=name, placement=placement, colour=colour, **form)

    def _read_geometry(
        self, scope: Scope, shape: ElementTree.Element, name: str, file: Path | None
    ) -> dict[str, Any]:
        """Return kind, size, file and triangles of a shape, as attributes of `Part`."""
        if file is not None:
            return self._read_mesh(scope, shape, name, file)
        size = tuple[float, ...]()
        for key, count in _SHAPES[shape.tag]:
            size += scope.read_numbers(shape, key, count, None, name)
        if min(size) <= 0.0:
            problem = "a shape without volume"
            expected = "sizes above 0"
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

    def _read_mesh(
        self, scope: Scope, shape: ElementTree.Element, name: str, file: Path
    ) -> dict[str, Any]:
        """Return kind, scale, and file or triangles of a <mesh>, as attributes of `Part`."""
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
            values = list[float]()
            for key in MOMENTS:
                default = _MOMENT if key in _DIAGONAL else 0
                (value,) = scope.read_numbers(moments, key, 1, f"{default}", local)
                values.append(value)
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

    def _read_colour(self, scope: Scope, element: ElementTree.Element, name: str) -> Colour | None:
        material = element.find("material")
        if material is None or material.find("diffuse") is None:
            return None
        rgba = (material.findtext("diffuse") or "").split()
        values = scope.read_numbers(material, "diffuse", len(rgba), "", name)
        if len(values) < 3:
            return _GREY
        # The opacity may be left out.
        red, green, blue, opacity = (*values, 1.0)[:4]
        return red, green, blue, opacity


def _read_any_number(
    scope: Scope, element: ElementTree.Element, key: str, default: str, where: str
) -> float:
    """Return the number of a child element, which may be infinite."""
    (value,) = scope.read_numbers(
        element, key, 1, default, where, largest=math.inf, is_finite=False
    )
    return value


def _read_rate_limit(stated: float) -> float | None:
    """Return a velocity or effort limit, or None for numbers that mean none."""
    return stated if MIN_POSITIVE <= stated < MAX_COORDINATE else None


def _get_name(element: ElementTree.Element) -> str:
    """Return the name of an element; an <include> states it in an element of its own."""
    stated = element.findtext("name") if element.tag == "include" else element.get("name")
    return (stated or "").strip()


def _note_other_versions(
    file: Path, root: ElementTree.Element, rules: Rules, version: int
) -> Iterator[str]:
    """Yield a note about each setting that another version has, and that would matter there."""
    # Up to 1.4 axes are in the model's frame, from 1.7 on in the joint's.
    is_in_model = rules.axis_frame is None
    for element in root.iter():
        name = None
        if element.tag == "use_parent_model_frame" and rules.axis_frame != element.tag:
            if is_true(element.text or "") != is_in_model:
                name = f"<{element.tag}>"
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
        configured = _find_configured_file(candidate)
        if configured is not None:
            return configured
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


def _find_configured_file(folder: Path) -> Path | None:
    """Return the newest SDF file that is read of those that a folder's model.config lists."""
    config = folder / "model.config"
    if not is_file(config):
        return None
    root = parse_xml(read_text(config, "model.config"), config)
    files = dict[int, str]()  # by their minor version
    for element in root.findall("sdf"):
        match = re.match(r"\s*1\.(\d{1,3})", element.get("version", "1.0"))
        if match is not None:
            files[int(match[1])] = (element.text or "").strip()
    versions = [version for version in files if version <= _NEWEST] or list(files)
    if not versions:
        return None
    newest = folder / files[max(versions)]
    return newest if is_file(newest) else None
