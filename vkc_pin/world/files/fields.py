"""Defines the types of fields that several description files share."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Collection
from typing import Annotated, Any, ClassVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    model_validator,
)
from pydantic_core import PydanticCustomError, core_schema

from vkc_pin.utils.arrays import MAX_COORDINATE, MIN_POSITIVE


def make_validation_error(problem: str, expected: str) -> PydanticCustomError:
    """Return the error of a validator."""
    return PydanticCustomError("vkc", "{problem}", {"problem": problem, "expected": expected})


def _reject_bool(value: Any) -> Any:
    if isinstance(value, bool):  # YAML reads yes and no as booleans, pydantic those as 1 and 0
        raise make_validation_error("wrong value", "a number")
    return value


def require(holds: Callable[[Any], object], problem: str, expected: str) -> AfterValidator:
    """Return a validator that rejects values for which `holds` is false."""

    def check(value: Any) -> Any:
        if not holds(value):
            raise make_validation_error(problem, expected)
        return value

    return AfterValidator(check)


def wrap_text(field: str) -> BeforeValidator:
    """Return a validator that accepts text in place of a schema with this field alone."""
    return BeforeValidator(lambda value: {field: value} if isinstance(value, str) else value)


def require_length(number: int) -> BeforeValidator:
    """Return a validator for lists of `number` values, since pydantic's error lacks the number."""

    def check(value: Any) -> Any:
        if not isinstance(value, list | tuple):
            raise make_validation_error("wrong value", f"a list of {number} values")
        if len(value) != number:
            raise make_validation_error("wrong number of values", f"{number} values")
        return value

    return BeforeValidator(check)


_IN_RANGE = require(
    lambda value: abs(value) <= MAX_COORDINATE,
    "out of range",
    f"a number from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}",
)
Number = Annotated[float, BeforeValidator(_reject_bool), Field(allow_inf_nan=False), _IN_RANGE]
_LARGE_ENOUGH = require(
    lambda value: value >= MIN_POSITIVE,
    "out of range",
    f"a number from {MIN_POSITIVE:g} to {MAX_COORDINATE:g}",
)
Positive = Annotated[Number, _LARGE_ENOUGH]
NonNegative = Annotated[Number, Field(ge=0.0)]
Vector3 = Annotated[tuple[Number, Number, Number], require_length(3)]
_NAME = re.compile(r"[^\s./]([^./]*[^\s./])?")


def is_name(text: str) -> bool:
    """Return whether a text may be the name of an obstacle, an object or a scene."""
    return text.isprintable() and _NAME.fullmatch(text) is not None


_VALID_NAME = require(is_name, "not a name", "text without '.', '/' or spaces around it")
Name = Annotated[str, _VALID_NAME]


def _normalize_quaternion(value: tuple[float, ...]) -> tuple[float, ...]:
    norm = math.hypot(*value)
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise make_validation_error(
            "not a rotation", f"a quaternion [x, y, z, w] of length 1, not {norm:.4g}"
        )
    return tuple(number / norm for number in value)


_NORM_TOLERANCE = 1e-3  # of lengths of quaternions: files have three decimals
Quaternion = Annotated[
    tuple[Number, Number, Number, Number], require_length(4), AfterValidator(_normalize_quaternion)
]
"""Unit quaternion [x, y, z, w]."""

# Fields that this program writes, and that others do not write by hand.
Text = Annotated[str, Field(strict=True)]
Count = Annotated[int, Field(strict=True, ge=0)]
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Measured = Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False)]
_FROM_NULL = BeforeValidator(lambda value: math.inf if value is None else value)
Distance = Annotated[float, Field(strict=True, gt=-math.inf), _FROM_NULL]
"""Perhaps infinite, for which JSON without infinite numbers has null, but not NaN."""


def _check_fields(data: Any, known: Collection[str], required: Collection[str] = ()) -> Any:
    """Return data if all of its fields are known, and all required ones are there."""
    if isinstance(data, dict):
        for name in data:
            if name not in known:
                context = {"name": str(name), "choices": list(known)}
                raise PydanticCustomError("unknown_field", "unknown field", context)
        for name in required:
            if name not in data:
                raise PydanticCustomError("missing_field", "missing", {"name": name})
    return data


class StoredRecord:
    """Base of dataclasses that are their own schema: the types of their fields check stored data.

    Only `parse_document` checks them, a call of the class does not. Unknown fields are errors that
    name the valid ones.
    """

    required_fields: ClassVar[tuple[str, ...]] = ()
    """Fields that stored data must have, though calls may leave them out."""

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        known = [item.name for item in dataclasses.fields(source)]

        def check(data: Any) -> Any:
            return _check_fields(data, known, cls.required_fields)

        return core_schema.no_info_before_validator_function(check, handler(source))


class Schema(BaseModel):
    """Base of all schemas: immutable, with errors for unknown fields that name the valid ones."""

    model_config = ConfigDict(frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _check_fields(cls, data: Any) -> Any:
        return _check_fields(data, cls.model_fields)


class JointSchema(Schema):
    """Limits of a joint that URDFs lack: [m/s] and [m/s²], or [rad/s] and [rad/s²]."""

    velocity: Positive | None = None
    acceleration: Positive | None = None
