"""Resolves names, frames and poses of SDF files by the rules of their version."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import MAX_COORDINATE
from vkc_pin.world.files.kinematic_tree import parse_numbers
from vkc_pin.world.files.xml import find_line, make_element_error

WORLD = "world"
"""Name of the world in SDF."""
BASE = "\0world"
"""The world among links: links of old files may be called "world"."""
# Position and rotation of an empty <pose>, by its `rotation_format`
_IDENTITIES = {"euler_rpy": "0 0 0 0 0 0", "quat_xyzw": "0 0 0 0 0 0 1"}


@dataclass(frozen=True)
class Rules:
    """What depends on the version.

    Attributes:
        since: First minor version.
        axis_frame: Element or attribute that changes the frame of a joint's axis from that of the
            joint; None: the axis is in the model's frame.
        pose_frame: Attribute of <pose> that names its frame.
    """

    since: int
    axis_frame: str | None
    pose_frame: str


RULES = (
    Rules(2, None, "frame"),
    Rules(5, "use_parent_model_frame", "frame"),
    Rules(7, "expressed_in", "relative_to"),
)
"""What each version of SDF means, oldest first; rules hold until the next ones."""


@dataclass(eq=False)
class Scope:
    """A <model> or <world>: named elements, and their poses in its frame.

    Attributes:
        file: File of the element.
        element: The <model>, <world> or, without a world, <sdf>.
        rules: Rules of the version of `file`.
        above: The model or world around it.
        path: Prefix of names of links and joints in the description.
        include: The <include> that it comes from.
        links, joints, frames: Elements by name.
        models: Nested models by name.
        merged: Included models whose elements count as elements of this model.
        active: Names that are being resolved, to find cycles.
    """

    file: Path
    element: ElementTree.Element
    rules: Rules
    above: Scope | None = None
    path: str = ""
    include: ElementTree.Element | None = None
    links: dict[str, ElementTree.Element] = field(default_factory=dict)
    joints: dict[str, ElementTree.Element] = field(default_factory=dict)
    frames: dict[str, ElementTree.Element] = field(default_factory=dict)
    models: dict[str, Scope] = field(default_factory=dict)
    merged: list[Scope] = field(default_factory=list)
    active: list[tuple[int, str]] = field(default_factory=list)
    _found: dict[str, pin.SE3] = field(default_factory=dict)
    _own_pose: pin.SE3 | None = None

    @property
    def is_static(self) -> bool:
        """Whether the model, or one around it, is static."""
        if is_true(self._find_setting("static")):
            return True
        return self.above is not None and self.above.is_static

    def _find_setting(self, name: str) -> str:
        """Return the text of an element of the <include>, else of the model, else nothing."""
        text = ""
        if self.include is not None:
            text = (self.include.findtext(name) or "").strip()
        return text or (self.element.findtext(name) or "").strip()

    def walk(self) -> Iterator[Scope]:
        """Yield this model and all inside it."""
        yield self
        for scope in (*self.models.values(), *self.merged):
            yield from scope.walk()

    def find_placement(self, name: str = "") -> pin.SE3:
        """Return a frame in the world; default: that of this model."""
        if self.above is None:
            return self.find_pose(name)
        return self.above.find_placement() * self._find_own_pose() * self.find_pose(name)

    def _find_own_pose(self) -> pin.SE3:
        """Return the frame of this model in that of the model or world around it.

        The <pose> is that of the frame F that `placement_frame` names, the model's own if there is
        none. With the model's frame M and the one around it W, ^W T_M = ^W T_F (^M T_F)⁻¹.
        """
        above = self.above
        if above is None:
            return pin.SE3.Identity()
        if self._own_pose is None:
            with_pose = self.element
            if self.include is not None and self.include.find("pose") is not None:
                with_pose = self.include
            placed = self.element.get("placement_frame", "")
            placed = (with_pose.findtext("placement_frame") or placed).strip()
            given = self._resolve("pose of the model", lambda: above.read_pose(with_pose, ""))
            self._own_pose = given * self.find_pose(placed).inverse()
        return self._own_pose

    def _resolve(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return the result of a function for a name, unless it leads back to the name."""
        key = (id(self), name)
        if key in self.active:
            first = self.active.index(key)
            cycle = [other for _, other in self.active[first:]]
            got = " → ".join([*cycle, name])
            raise InputError("frames form a cycle", file=self.file, field=name, got=got)
        self.active.append(key)
        try:
            return compute()
        finally:
            self.active.pop()

    def find_pose(self, name: str) -> pin.SE3:
        """Return the frame of a link, frame, joint or nested model in the frame of this model."""
        if name in ("", "__model__"):
            return pin.SE3.Identity()
        if name not in self._found:
            self._found[name] = self._resolve(name, lambda: self._compute_pose(name))
        return self._found[name]

    def _compute_pose(self, name: str) -> pin.SE3:
        if name in self.links:
            return self.read_pose(self.links[name], "")
        if name in self.frames:
            frame = self.frames[name]
            return self.read_pose(frame, frame.get("attached_to", "").strip())
        if name in self.joints:
            return self.find_joint_pose(self.joints[name])
        inner = self._find_inner(name)
        if inner is not None:
            scope, rest = inner
            return scope._find_own_pose() * scope.find_pose(rest)
        if name == WORLD:
            return self.find_placement().inverse()
        raise UnknownNameError("frame", name, self._list_names(), file=self.file)

    def _find_inner(self, name: str) -> tuple[Scope, str] | None:
        """Return the nested model in which a name is defined, and the name in it."""
        first, _, rest = name.partition("::")
        if first in self.models:
            return self.models[first], rest
        for scope in self.merged:
            if scope.defines(name):
                return scope, name
        return None

    def defines(self, name: str) -> bool:
        """Return whether the name is one of an element of this model."""
        return (
            name in self.links
            or name in self.frames
            or name in self.joints
            or self._find_inner(name) is not None
        )

    def _list_names(self) -> list[str]:
        names = [*self.links, *self.frames, *self.joints, *self.models]
        for scope in self.merged:
            names += scope._list_names()
        return names

    def find_joint_pose(self, joint: ElementTree.Element) -> pin.SE3:
        """Return the frame of a joint in the frame of this model."""
        return self.read_pose(joint, self.read_end(joint, "child"))

    def read_pose(self, element: ElementTree.Element, default_frame: str) -> pin.SE3:
        """Return the <pose> of an element in the frame of this model."""
        pose = element.find("pose")
        where = element.get("name", element.tag)
        if pose is None:
            return self.find_pose(default_frame)
        stated = pose.get("relative_to") or pose.get(self.rules.pose_frame) or default_frame
        form = pose.get("rotation_format", "euler_rpy").strip()
        if form not in _IDENTITIES:
            raise UnknownNameError(
                "rotation_format",
                form,
                _IDENTITIES,
                file=self.file,
                line=find_line(pose),
                field=where,
            )
        default = _IDENTITIES[form]
        count = len(default.split())
        values = self._parse(pose, pose.text, count, default, f"{where}: pose")
        position = np.array(values[:3])
        turn = np.array(values[3:])
        is_degrees = is_true(pose.get("degrees", "false"))
        if form == "euler_rpy":
            angles = np.radians(turn) if is_degrees else turn
            rotation = pin.rpy.rpyToMatrix(*angles)
        elif is_degrees or not np.linalg.norm(turn) > 0.0:
            problem = "a quaternion in degrees" if is_degrees else "a quaternion of length 0"
            raise make_element_error(self.file, pose, problem, field=where, got=pose.text)
        else:
            rotation = pin.Quaternion(turn).normalized().matrix()
        return self.find_pose(stated.strip()) * pin.SE3(rotation, position)

    def find_link(self, name: str) -> str:
        """Return the name, in the description, of the link that a frame is attached to."""
        if name in self.links:
            return self.path + name
        return str(self._resolve(name, lambda: self._follow_to_link(name)))

    def _follow_to_link(self, name: str) -> str:
        if name in ("", "__model__"):
            return self._find_canonical_link()
        if name in self.frames:
            return self.find_link(self.frames[name].get("attached_to", "").strip())
        if name in self.joints:
            return self.find_link(self.read_end(self.joints[name], "child"))
        inner = self._find_inner(name)
        if inner is not None:
            scope, rest = inner
            return scope.find_link(rest)
        if name == WORLD:
            return BASE
        names = [*self._list_names(), WORLD]
        raise UnknownNameError("link", name, names, file=self.file, field=self.element.get("name"))

    def _find_canonical_link(self) -> str:
        """Return the link of this model that its frame is attached to, by default the first."""
        if self.above is None:
            return BASE
        stated = self.element.get("canonical_link", "").strip()
        if stated:
            return self.find_link(stated)
        if self.links:
            return self.path + next(iter(self.links))
        inner = [*self.models.values(), *self.merged]
        if not inner:
            problem = "a model without links"
            name = self.element.get("name")
            raise make_element_error(self.file, self.element, problem, field=name)
        return inner[0].find_link("")

    def read_end(self, joint: ElementTree.Element, key: str) -> str:
        """Return the frame that a joint names as its "parent" or "child"."""
        name = (joint.findtext(key) or "").strip()
        if not name:
            problem = "a joint that connects nothing"
            where = joint.get("name", "")
            raise make_element_error(self.file, joint, problem, field=where, expected=f"<{key}>")
        return name

    def read_numbers(
        self,
        element: ElementTree.Element,
        key: str,
        count: int,
        default: str | None,
        where: str,
        *,
        largest: float = MAX_COORDINATE,
        is_finite: bool = True,
    ) -> tuple[float, ...]:
        """Return the numbers of a child element, infinite ones only without `is_finite`."""
        found = element.find(key)
        text = None if found is None else found.text or ""
        named = f"{where}: {element.tag} {key}"
        holder = element if found is None else found
        return self._parse(holder, text, count, default, named, largest, is_finite=is_finite)

    def _parse(
        self,
        element: ElementTree.Element,
        text: str | None,
        count: int,
        default: str | None,
        where: str,
        largest: float = MAX_COORDINATE,
        *,
        is_finite: bool = True,
    ) -> tuple[float, ...]:
        holder = ElementTree.Element(element.tag)
        # An empty element means the default.
        if text is not None and text.strip():
            holder.set("text", text)
        try:
            return parse_numbers(
                self.file,
                holder,
                "text",
                count,
                default=default,
                where=where,
                largest=largest,
                is_finite=is_finite,
            )
        except InputError as error:
            raise make_element_error(
                self.file,
                element,
                error.problem,
                field=where,
                expected=error.expected,
                got=error.got,
            ) from None


def is_true(text: str) -> bool:
    """Return whether a text is true in SDF."""
    return text.strip().lower() in ("1", "true")
