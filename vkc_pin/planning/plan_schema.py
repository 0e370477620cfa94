"""Defines the schema of saved plans."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.types import FailFast

from vkc_pin.validation.report import Report
from vkc_pin.world.files.fields import Count, Distance, Finite, Measured, Schema, Text, require
from vkc_pin.world.trajectory.trajectory import TrajectorySchema


class MetricsSchema(BaseModel):
    """Metrics of every plan; baselines have more."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Finite]

    planning_time: Measured
    build_time: Measured
    base_path_length: Measured
    base_path_length_l1: Measured
    arm_path_length: Measured
    clearance: Distance
    closure_error: Measured
    duration: Measured
    iterations: Measured
    rounds: Measured
    time_initialization: Measured
    time_coal: Measured
    time_casadi: Measured
    time_ipopt: Measured
    time_validation: Measured
    # Older files lack these.
    evaluations: Measured = 0.0
    time_retiming: Measured = 0.0
    torque: Measured = 0.0


Folder = Annotated[
    dict[str, Text],
    require(
        lambda folder: folder == {"package": "scenes"} or set(folder) == {"relative", "absolute"},
        "no folder of a scene",
        'package: "scenes", or relative and absolute',
    ),
]
_Row = dict[str, Annotated[bool, Field(strict=True)] | Annotated[float, Field(strict=True)]]


class PlanSchema(Schema):
    """A saved plan; scenes, steps, options and terms check their own parts."""

    format: int
    scene: dict[str, Any]
    folder: Folder
    steps: Annotated[list[dict[str, Any]], FailFast()]
    options: dict[str, Any]
    trajectory: TrajectorySchema
    validation: Report
    # Other planners have words of their own, see `Plan.status`.
    status: Annotated[str, Field(strict=True, pattern=r"^[a-z][a-z ]{0,39}$")]
    metrics: MetricsSchema
    seed: Count
    initialization: Text
    is_optimized: bool = True  # older files lack it
    history: Annotated[list[_Row], FailFast()]
    terms: Annotated[list[dict[str, Any]], FailFast()] = Field(default_factory=list)
