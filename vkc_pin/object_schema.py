"""What a description file of an articulated object may contain, and the value types shared with scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

__all__ = [
    "AttachmentSchema",
    "JointSchema",
    "LatchSchema",
    "Name",
    "Number",
    "ObjectSchema",
    "Positive",
    "Schema",
    "Vector3",
    "count",
    "fail",
]


def fail(problem: str, expected: str) -> PydanticCustomError:
    """Return (not raise) the error of a validator: what is wrong and what would be right."""
    return PydanticCustomError("vkc", "{problem}", {"problem": problem, "expected": expected})


def _number(value: Any) -> Any:
    if isinstance(value, bool):  # YAML turns yes, no, on, off into booleans, and pydantic those into 1 and 0
        raise fail("wrong value", "a number")
    return value


def _name(value: str) -> str:
    if not value or value != value.strip() or "." in value or "/" in value:
        raise fail("not a name", "text without '.', '/' or spaces around it")
    return value


def _direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if np.linalg.norm(value) < 1e-6:
        raise fail("a direction cannot be zero", "a vector of some length")
    return value


def _around_zero(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] <= 0.0 <= value[1]:
        raise fail("the limits do not contain 0", "limits [lower <= 0, upper >= 0]")
    return value


def _some(value: tuple[Any, ...]) -> tuple[Any, ...]:
    if not value:
        raise fail("nothing in the list", "at least one")
    return value


def count(number: int) -> BeforeValidator:
    """Return the validator that wants a list of `number` values: pydantic alone would not say how many it expected."""

    def counted(value: Any) -> Any:
        if not isinstance(value, list | tuple):
            raise fail("wrong value", f"a list of {number} values")
        if len(value) != number:
            raise fail("wrong number of values", f"{number} values")
        return value

    return BeforeValidator(counted)


Number = Annotated[float, BeforeValidator(_number), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Vector3 = Annotated[tuple[Number, Number, Number], count(3)]
Limits = Annotated[tuple[Number, Number], count(2), AfterValidator(_around_zero)]
Direction = Annotated[Vector3, AfterValidator(_direction)]
Name = Annotated[str, AfterValidator(_name)]


class Schema(BaseModel):
    """Base of all schemas: immutable, and an unknown field is an error that knows the valid ones."""

    model_config = ConfigDict(frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _known_fields(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise PydanticCustomError(
                        "unknown_field", "unknown field", {"name": str(key), "choices": list(cls.model_fields)}
                    )
        return data


class JointSchema(Schema):
    """What a URDF cannot say about a joint: [m/s] and [m/s²], or [rad/s] and [rad/s²]."""

    velocity: Positive | None = None
    acceleration: Positive | None = None


class AttachmentSchema(Schema):
    """Where and how a tool takes hold of a link; see `vkc_pin.articulation.Attachment`."""

    name: Name
    link: str
    position: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 | None = None
    approach: Direction | None = None
    closing: Direction | None = None
    joint: Literal["fixed", "revolute", "prismatic", "cylindrical", "spherical"] = "fixed"
    axis: Direction | None = None
    limits: Limits | None = None
    turn: Limits | None = None
    standoff: NotNegative = 0.0
    firm: bool | None = None  # not stated: as the object is free or not

    @model_validator(mode="after")
    def _consistent(self) -> AttachmentSchema:
        if (self.approach is None) != (self.closing is None) or (self.rpy is not None and self.approach is not None):
            raise fail("the tool's direction is not clear", "either rpy, or approach and closing")
        if self.approach is not None and self.closing is not None and abs(np.dot(self.approach, self.closing)) > 1e-9:
            raise fail("approach and closing are not perpendicular", "two perpendicular directions")
        has_axis = self.joint in ("revolute", "prismatic", "cylindrical")
        if has_axis != (self.axis is not None):
            raise fail("axis and joint do not fit", "an axis with joint revolute, prismatic or cylindrical, and only there")
        if has_axis and self.limits is None:
            raise fail("limits missing", "limits [lower, upper] of the grasp's joint")
        if self.joint == "fixed" and self.limits is not None:
            raise fail("a fixed grasp has no limits", "no limits, or another joint")
        if (self.joint == "cylindrical") != (self.turn is not None):
            raise fail("turn and joint do not fit", "turn [lower, upper] with joint cylindrical, and only there")
        return self


class LatchSchema(Schema):
    """A joint held until another one is moved; see `vkc_pin.articulation.Latch`."""

    joint: str
    held_at: Number = 0.0
    released_by: str
    threshold: Number
    engaged_within: Positive


class ObjectSchema(Schema):
    """A description file of an articulated object."""

    urdf: str
    free: bool = False
    joints: Mapping[str, JointSchema] = Field(default_factory=dict)
    attachments: Annotated[tuple[AttachmentSchema, ...], AfterValidator(_some)]
    latches: tuple[LatchSchema, ...] = ()
