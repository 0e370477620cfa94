"""Defines terms of recipes: constraints for robots and objects that are sampled later."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field

from vkc_pin.simulation.cameras.mount import BASE, HAND, resolve_frame
from vkc_pin.utils.arguments import check_choice
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.fields import Positive, Schema, Vector3, require, require_length
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.terms import (
    Constraint,
    State,
    Term,
    rename_term,
    term_from_dict,
    term_to_dict,
    trace_terms_without_scene,
)

__all__ = [
    "OBJECT",
    "KeepOutSchema",
    "SpeedSchema",
    "TermSchema",
    "TracedSchema",
    "UprightSchema",
    "check_entries",
    "check_robot",
    "make_entries",
    "resolve_terms",
]

OBJECT = "object"
"""Frame of the grasped link, and the grasped object in `holding`."""

Axis = Annotated[
    Vector3,
    require(lambda value: math.hypot(*value) > 0.0, "no direction", "an axis of some length"),
]
Size = Annotated[tuple[Positive, Positive, Positive], require_length(3)]


class _Entry(Schema):
    """A term: its name, and the tasks in which it holds; all if there are none."""

    name: str | None = None
    tasks: tuple[str, ...] = ()

    def term(self) -> Term:
        """Return the term with frames `BASE`, `HAND`, `OBJECT`, or frames by name."""
        raise NotImplementedError


class _Framed(_Entry):
    type: str
    frame: str = HAND
    held: bool = False

    @property
    def called(self) -> str:
        """Name in reports."""
        return self.name or f"{self.type} {self.frame}"

    @property
    def holding(self) -> str | None:
        """Object that must be grasped for it."""
        return OBJECT if self.held else None


class UprightSchema(_Framed):
    """Limits the angle of a frame's axis from the vertical [rad]."""

    type: Literal["upright"]
    axis: Axis = (0.0, 0.0, 1.0)
    angle: Annotated[Positive, Field(lt=math.pi)] = 0.2

    def term(self) -> Term:
        """Return the constraint on the vertical component of the axis."""
        unit = [value / math.hypot(*self.axis) for value in self.axis]

        def rises(s: State) -> Any:
            return sum(value * s.rotation(self.frame)[2, k] for k, value in enumerate(unit))

        return Constraint(self.called, rises, lower=math.cos(self.angle), holding=self.holding)


class SpeedSchema(_Framed):
    """Limits the speed of a frame's origin [m/s]."""

    type: Literal["speed"]
    most: Positive

    def term(self) -> Term:
        """Return the constraint on the speed."""

        def speed(s: State) -> Any:
            moved = s.velocity(self.frame)
            return (moved.T @ moved) ** 0.5

        return Constraint(self.called, speed, upper=self.most, holding=self.holding)


class KeepOutSchema(_Framed):
    """Keeps the origin of a frame out of a box in the world frame."""

    type: Literal["keep-out"]
    position: Vector3
    size: Size

    def term(self) -> Term:
        """Return the constraint on the largest distance outside along an axis of the box [m]."""

        def outside(s: State) -> Any:
            away = s.position(self.frame)
            x, y, z = ((away[k] - self.position[k]).fabs() - self.size[k] / 2.0 for k in range(3))
            return x.fmax(y).fmax(z)

        return Constraint(self.called, outside, lower=0.0, holding=self.holding)


class TracedSchema(_Entry):
    """A constraint or cost as recorded arithmetic operations."""

    type: Literal["traced"]
    traced: dict[str, Any]

    def term(self) -> Term:
        """Return the term."""
        return term_from_dict(self.traced)


TermSchema = Annotated[
    UprightSchema | SpeedSchema | KeepOutSchema | TracedSchema, Field(discriminator="type")
]
Entry = UprightSchema | SpeedSchema | KeepOutSchema | TracedSchema


def make_entries(terms: Sequence[Term]) -> list[dict[str, Any]]:
    """Return terms as plain entries of a recipe.

    Raises:
        InputError: They are no terms, or name phases, which are not known yet.
    """
    for term in (found := trace_terms_without_scene(terms)):
        if term.during is not None:
            expected = (
                f"holding={OBJECT!r}, or nothing: phases are called after objects that are drawn"
            )
            raise term.make_error("phases are not known yet", "during", expected, list(term.during))
    return [{"type": "traced", "traced": term_to_dict(term)} for term in found]


def check_entries(document: Document, entries: Sequence[Entry], tasks: Sequence[str]) -> None:
    """Check the terms of a recipe.

    Raises:
        InputError: A term is wrong, or two have one name; the error names file, line and field.
    """
    names: list[str] = []
    for k, entry in enumerate(entries):
        for j, task in enumerate(entry.tasks):
            if task not in tasks:
                raise document.make_unknown_name_error(
                    ("terms", k, "tasks", j), "task", task, tasks
                )
        with document.annotate_errors(("terms", k)):
            (term,) = trace_terms_without_scene([entry.term()])
        if term.name in names:
            raise document.make_error(
                ("terms", k), "two terms of one name", expected="another `name`", got=term.name
            )
        names.append(term.name)


def check_robot(robot: Robot, terms: Sequence[Term]) -> None:
    """Check that a robot has the frames and coordinates of terms, except those of objects.

    Raises:
        UnknownNameError: It lacks one.
    """
    frames = sorted(
        {BASE, HAND, OBJECT, *(str(frame.name) for frame in robot.model.frames)} - {"universe"}
    )
    for term in terms:
        where = f"terms[{term.name!r}]"
        for frame in (name for name in term.formula.frames if "." not in name):
            check_choice(frame, frames, f"frame of {robot.name}", where)
        for coordinate in (name for name in term.formula.coordinates if "." not in name):
            check_choice(coordinate, robot.coordinates.names, f"coordinate of {robot.name}", where)


def resolve_terms(
    terms: Sequence[Term], scene: Scene, name: str, attachment: str
) -> tuple[Term, ...]:
    """Return terms with the frames of a scene.

    Args:
        terms: Terms with `BASE`, `HAND` and `OBJECT`.
        scene: Scene.
        name: Object of the episode.
        attachment: Attachment that is grasped.
    """
    link = scene.objects[name].object.attachments[attachment].link
    frames = {word: resolve_frame(scene.robot, word) for word in (BASE, HAND)} | {
        OBJECT: f"{name}.{link}"
    }
    return tuple(rename_term(term, frames, {OBJECT: name}) for term in terms)
