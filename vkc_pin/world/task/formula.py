"""Expressions of coordinates and frames: asked for by symbols, kept as plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.utils.arguments import known, text
from vkc_pin.utils.arrays import Floats

__all__ = ["Formula", "State"]

# added under every root: a root has no slope at zero, where the norm of a velocity is at rest
ROUNDING = 1e-8
_COMPARISONS = ("lt", "le", "eq", "ne", "and", "or", "not")


class State:
    """What a term may ask for at a waypoint, as CasADi symbols.

    Coordinates are those of the robot (`base_x`, `elbow_joint`) and of objects (`door.hinge`);
    frames are those of the robot, links among them, and links of objects (`cup.cup`, `door.panel`),
    whoever holds them. Everything is in the world frame. All methods raise `UnknownNameError` for a
    name that does not exist. Where it is not known yet what there will be (None), any name does.
    """

    def __init__(
        self,
        frames: Sequence[str] | None,
        coordinates: Sequence[str] | None,
        field: str | None = None,
    ) -> None:
        self._field = field  # for errors
        self._known = {"frame": frames, "coordinate": coordinates}
        self._symbols: Mapping[str, dict[str, tuple[Any, Any]]] = {"frame": {}, "coordinate": {}}
        self._dt = ca.SX.sym("dt")

    def coordinate(self, name: str) -> Any:
        """Return the value of a coordinate, [m] or [rad]."""
        return self._of("coordinate", name)[0]

    def rate(self, name: str) -> Any:
        """Return how fast a coordinate has changed since the waypoint before, [m/s] or [rad/s]."""
        now, before = self._of("coordinate", name)
        return (now - before) / self._dt

    def rotation(self, frame: str) -> Any:
        """Return the rotation of a frame, shape (3, 3): its columns are the frame's axes."""
        return ca.reshape(self._of("frame", frame)[0][:9], 3, 3)

    def position(self, frame: str) -> Any:
        """Return the position of a frame, shape (3, 1) [m]."""
        return self._of("frame", frame)[0][9:]

    def velocity(self, frame: str) -> Any:
        """Return how fast a frame's position has changed since the waypoint before, shape (3, 1) [m/s]."""
        now, before = self._of("frame", frame)
        return (now[9:] - before[9:]) / self._dt

    def check_names(self, formula: Formula) -> None:
        """Check that everything exists that a formula depends on."""
        for kind, names in (("frame", formula.frames), ("coordinate", formula.coordinates)):
            for name in names:
                self._of(kind, name)

    def _of(self, kind: str, name: str) -> tuple[Any, Any]:
        """Return symbols of a coordinate, or of a frame's rotation (by columns) and position: now and before."""
        choices = self._known[kind]
        if choices is None:
            text(name, self._field or kind, f"the name of a {kind}")
        else:
            known(name, choices, kind, self._field)
        size = 12 if kind == "frame" else 1
        return self._symbols[kind].setdefault(
            name, (ca.SX.sym("now", size), ca.SX.sym("before", size))
        )

    def make_formula(self, value: Any) -> Formula:
        """Return an expression of this state's symbols, shape (rows, 1), as data."""
        columns = [
            [
                pair[when]
                for kind in ("frame", "coordinate")
                for pair in self._symbols[kind].values()
            ]
            for when in (0, 1)
        ]
        inputs = ca.vertcat(*columns[0], *columns[1], self._dt)
        function = ca.Function("term", [inputs], [ca.densify(value)])
        code = []
        for k in range(function.n_instructions()):
            name, constant = _operations()[function.instruction_id(k)], 0.0
            read, written = function.instruction_input(k), function.instruction_output(k)
            if name == "const":
                constant = float(function.instruction_constant(k))
            code.append(
                (name, tuple(read[1:] if name == "input" else read), int(written[-1]), constant)
            )
        return Formula(
            tuple(self._symbols["frame"]),
            tuple(self._symbols["coordinate"]),
            value.numel(),
            tuple(code),
        )


@dataclass(frozen=True)
class Formula:
    """An expression as plain data: equal ones are equal, files can hold it, and reading it runs nothing.

    Its inputs, in one column: of every frame rotation (by columns) and position, the coordinates,
    both again one step before, and the time of that step.

    Attributes:
        frames, coordinates: Names of what it depends on.
        rows: How many numbers it returns.
        code: Operations in order: name, where the operands are, where the result goes, constant.
    """

    frames: tuple[str, ...]
    coordinates: tuple[str, ...]
    rows: int
    code: tuple[tuple[str, tuple[int, ...], int, float], ...]

    @property
    def has_comparison(self) -> bool:
        """Whether a result is that of a comparison, which has no slope."""
        results: dict[int, str] = {}
        for name, read, written, _ in self.code:
            if name == "output" and results.get(read[0]) in _COMPARISONS:
                return True
            results[written if name != "output" else -1] = name
        return False

    @property
    def state_size(self) -> int:
        """How many of the inputs are about the present."""
        return 12 * len(self.frames) + len(self.coordinates)

    @cached_property
    def input_indices(self) -> frozenset[int]:
        """Which of the inputs it depends on."""
        return frozenset(read[0] for name, read, _, _ in self.code if name == "input")

    @property
    def uses_previous(self) -> bool:
        """Whether it depends on the waypoint before."""
        return any(self.state_size <= index < 2 * self.state_size for index in self.input_indices)

    @property
    def uses_time_step(self) -> bool:
        """Whether it depends on the time of a step."""
        return 2 * self.state_size in self.input_indices

    @cached_property
    def function(self) -> ca.Function:
        """The CasADi function, inputs of shape (2·half + 1, 1) to shape (rows, 1); roots are rounded off at zero."""
        numbers = {name: number for number, name in _operations().items()}
        inputs = ca.SX.sym("inputs", 2 * self.state_size + 1)
        work: dict[int, Any] = {}
        results: list[Any] = [ca.SX(0)] * self.rows
        for name, read, written, constant in self.code:
            operands = [work[index] for index in read] if name != "input" else []
            if name == "input":
                work[written] = inputs[read[0]]
            elif name == "const":
                work[written] = ca.SX(constant)
            elif name == "output":
                results[written] = operands[0]
            elif len(operands) == 1:
                work[written] = ca.SX.unary(
                    numbers[name], operands[0] + (ROUNDING if name == "sqrt" else 0.0)
                )
            else:
                work[written] = ca.SX.binary(numbers[name], *operands)
        return ca.Function("term", [inputs], [ca.vertcat(*results)])

    def evaluate(self, inputs: Floats) -> Floats:
        """Return its values, shape (S, rows), at inputs of shape (S, 2·half + 1)."""
        return (
            np.asarray(self.function(np.ascontiguousarray(inputs.T)), float)
            .reshape(self.rows, len(inputs))
            .T
        )


@cache
def _operations() -> dict[int, str]:
    """Return CasADi's operations by number; files name them."""
    return {
        getattr(ca, name): name.removeprefix("OP_").lower()
        for name in dir(ca)
        if name.startswith("OP_")
    }
