"""Defines expressions of coordinates and frames, built from CasADi symbols and stored as data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_choice, check_text
from vkc_pin.utils.arrays import Floats

__all__ = ["Formula", "State"]

# Added under every square root, whose derivative is infinite at zero (as for a zero velocity).
ROUNDING = 1e-8
_COMPARISONS = ("lt", "le", "eq", "ne", "and", "or", "not")


class State:
    """The quantities that a term may use at a waypoint, as CasADi symbols.

    Coordinates are those of the robot (`base_x`, `elbow_joint`) and of objects (`door.hinge`);
    frames are those of the robot, including its links, and links of objects (`cup.cup`,
    `door.panel`), held or not. Everything is in the world frame. All methods raise
    `UnknownNameError` for a name that does not exist. If `frames` or `coordinates` are None, any
    name is accepted.
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
        return self._find_symbols("coordinate", name)[0]

    def rate(self, name: str) -> Any:
        """Return the mean rate of a coordinate since the previous waypoint, [m/s] or [rad/s]."""
        now, before = self._find_symbols("coordinate", name)
        return (now - before) / self._dt

    def rotation(self, frame: str) -> Any:
        """Return the rotation of a frame, shape (3, 3); its columns are the frame's axes."""
        return ca.reshape(self._find_symbols("frame", frame)[0][:9], 3, 3)

    def position(self, frame: str) -> Any:
        """Return the position of a frame, shape (3, 1) [m]."""
        return self._find_symbols("frame", frame)[0][9:]

    def velocity(self, frame: str) -> Any:
        """Return the mean velocity of a frame since the previous waypoint, shape (3, 1) [m/s]."""
        now, before = self._find_symbols("frame", frame)
        return (now[9:] - before[9:]) / self._dt

    def check_names(self, formula: Formula) -> None:
        """Check that all frames and coordinates of a formula exist."""
        for kind, names in (("frame", formula.frames), ("coordinate", formula.coordinates)):
            for name in names:
                self._find_symbols(kind, name)

    def _find_symbols(self, kind: str, name: str) -> tuple[Any, Any]:
        """Return the present and previous symbols of a coordinate or frame.

        The symbol of a frame has its rotation (by columns) and position.
        """
        choices = self._known[kind]
        if choices is None:
            check_text(name, self._field or kind, f"the name of a {kind}")
        else:
            check_choice(name, choices, kind, self._field)
        size = 12 if kind == "frame" else 1
        return self._symbols[kind].setdefault(
            name, (ca.SX.sym("now", size), ca.SX.sym("before", size))
        )

    def make_formula(self, value: Any) -> Formula:
        """Return an expression of this state's symbols, shape (rows, 1), as plain data."""
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
            name, constant = _list_operations()[function.instruction_id(k)], 0.0
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
    """An expression as plain data: comparable, storable in files, and safe to read.

    Its inputs form one column: rotation (by columns) and position of every frame, the coordinates,
    the same at the previous waypoint, and the time step.

    Attributes:
        frames, coordinates: Names of the frames and coordinates that it uses.
        rows: Number of results.
        code: Operations in order: name, indices of the operands, index of the result, constant.
    """

    frames: tuple[str, ...]
    coordinates: tuple[str, ...]
    rows: int
    code: tuple[tuple[str, tuple[int, ...], int, float], ...]

    def __post_init__(self) -> None:
        outputs = sorted(written for name, _, written, _ in self.code if name == "output")
        if len(outputs) != self.rows or outputs != list(range(self.rows)):
            expected = f"one output operation for each of {self.rows} rows"
            raise InputError("wrong number of results", field="rows", expected=expected)

    @property
    def has_comparison(self) -> bool:
        """Whether a result is that of a comparison, which has no derivative."""
        results: dict[int, str] = {}
        for name, read, written, _ in self.code:
            if name == "output" and results.get(read[0]) in _COMPARISONS:
                return True
            results[written if name != "output" else -1] = name
        return False

    @property
    def state_size(self) -> int:
        """Number of inputs that describe the present waypoint."""
        return 12 * len(self.frames) + len(self.coordinates)

    @cached_property
    def input_indices(self) -> frozenset[int]:
        """Indices of the inputs that it depends on."""
        return frozenset(read[0] for name, read, _, _ in self.code if name == "input")

    @property
    def uses_previous(self) -> bool:
        """Whether it depends on the previous waypoint."""
        return any(self.state_size <= index < 2 * self.state_size for index in self.input_indices)

    @property
    def uses_time_step(self) -> bool:
        """Whether it depends on the time step."""
        return 2 * self.state_size in self.input_indices

    @cached_property
    def function(self) -> ca.Function:
        """CasADi function, inputs of shape (2·state_size + 1, 1) to results of shape (rows, 1).

        Square roots are smoothed at zero by `ROUNDING`.
        """
        numbers = {name: number for number, name in _list_operations().items()}
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
        """Return its results, shape (S, rows), at inputs of shape (S, 2·state_size + 1)."""
        return (
            np.asarray(self.function(np.ascontiguousarray(inputs.T)), float)
            .reshape(self.rows, len(inputs))
            .T
        )


@cache
def _list_operations() -> dict[int, str]:
    """Return CasADi's operations by number, with the names used in files."""
    return {
        getattr(ca, name): name.removeprefix("OP_").lower()
        for name in dir(ca)
        if name.startswith("OP_")
    }
