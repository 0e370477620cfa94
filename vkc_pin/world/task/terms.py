"""Defines constraints and costs of users: expressions of coordinates and frames, stored as data.

The user's function is called once, with symbols, and its result is stored as plain data. The
nonlinear program composes that with its kinematics; validation evaluates it independently.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arguments import (
    check_array,
    check_choice,
    check_finite_array,
    check_list,
    check_mapping,
    check_number,
    check_text,
)
from vkc_pin.utils.arrays import Floats

if TYPE_CHECKING:
    from vkc_pin.world.scene.scene import Scene


# Added under every square root, whose derivative is infinite at zero (as for a zero velocity).
ROUNDING = 1e-8
_COMPARISONS = ("lt", "le", "eq", "ne", "and", "or", "not")
_CONSTANT = "it does not depend on the state"
_DEPENDENT = "an expression of symbols that the State returns"
Numbers = float | Sequence[float] | NDArray[np.float64]


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
        now, _ = self._find_symbols("coordinate", name)
        return now

    def rate(self, name: str) -> Any:
        """Return the mean rate of a coordinate since the previous waypoint, [m/s] or [rad/s]."""
        now, before = self._find_symbols("coordinate", name)
        return (now - before) / self._dt

    def rotation(self, frame: str) -> Any:
        """Return the rotation of a frame, shape (3, 3); its columns are the frame's axes."""
        now, _ = self._find_symbols("frame", frame)
        return ca.reshape(now[:9], 3, 3)

    def position(self, frame: str) -> Any:
        """Return the position of a frame, shape (3, 1) [m]."""
        now, _ = self._find_symbols("frame", frame)
        return now[9:]

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
        symbols = self._symbols[kind]
        if name not in symbols:
            size = 12 if kind == "frame" else 1
            symbols[name] = (ca.SX.sym("now", size), ca.SX.sym("before", size))
        return symbols[name]

    def make_formula(self, value: Any) -> Formula:
        """Return an expression of this state's symbols, shape (rows, 1), as plain data."""
        frames = self._symbols["frame"]
        coordinates = self._symbols["coordinate"]
        pairs = [*frames.values(), *coordinates.values()]
        present = [now for now, _ in pairs]
        previous = [before for _, before in pairs]
        inputs = ca.vertcat(*present, *previous, self._dt)
        function = ca.Function("term", [inputs], [ca.densify(value)])
        code = []
        for k in range(function.n_instructions()):
            name = _list_operations()[function.instruction_id(k)]
            read = function.instruction_input(k)
            written = function.instruction_output(k)
            # An input is read from the argument read[0], of which there is one, at read[1].
            operands = tuple(read[1:]) if name == "input" else tuple(read)
            constant = float(function.instruction_constant(k)) if name == "const" else 0.0
            code.append((name, operands, int(written[-1]), constant))
        return Formula(tuple(frames), tuple(coordinates), value.numel(), tuple(code))


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
        operations: dict[int, str] = {}  # index of a result → the operation that wrote it last
        for name, read, written, _ in self.code:
            if name != "output":
                operations[written] = name
            elif operations.get(read[0]) in _COMPARISONS:
                return True
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
            if name == "input":
                work[written] = inputs[read[0]]
                continue
            operands = [work[index] for index in read]
            if name == "const":
                work[written] = ca.SX(constant)
            elif name == "output":
                results[written] = operands[0]
            elif len(operands) == 1:
                shift = ROUNDING if name == "sqrt" else 0.0
                work[written] = ca.SX.unary(numbers[name], operands[0] + shift)
            else:
                work[written] = ca.SX.binary(numbers[name], *operands)
        return ca.Function("term", [inputs], [ca.vertcat(*results)])

    def evaluate(self, inputs: Floats) -> Floats:
        """Return its results, shape (S, rows), at inputs of shape (S, 2·state_size + 1)."""
        columns = np.ascontiguousarray(inputs.T)
        results = np.asarray(self.function(columns), float)
        return results.reshape(self.rows, len(inputs)).T


@cache
def _list_operations() -> dict[int, str]:
    """Return CasADi's operations by number, with the names used in files."""
    operations = {}
    for name in dir(ca):
        if name.startswith("OP_"):
            operations[getattr(ca, name)] = name.removeprefix("OP_").lower()
    return operations


Expression = Callable[[State], Any] | Formula


@dataclass(frozen=True)
class _Term:
    name: str
    expression: Expression
    _: KW_ONLY
    during: Sequence[str] | str | None = None
    holding: str | None = None

    def _check(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(
                "not a name",
                field=f"{type(self).__name__}.name",
                expected="text",
                got=format_value(self.name),
            )
        if not callable(self.expression) and not isinstance(self.expression, Formula):
            expected = "a function of a State, e.g. lambda s: s.coordinate('elbow_joint')"
            got = format_value(self.expression)
            raise self.make_error("not a function", "expression", expected, got)
        if self.during is not None:
            names = (self.during,) if isinstance(self.during, str) else self.during
            is_list = isinstance(names, list | tuple) and len(names) > 0
            if not is_list or not all(isinstance(name, str) for name in names):
                expected = "names of phases, e.g. ['place cup']"
                got = format_value(self.during)
                raise self.make_error("not phases", "during", expected, got)
            object.__setattr__(self, "during", tuple(names))
        if self.holding is not None and not isinstance(self.holding, str):
            got = format_value(self.holding)
            raise self.make_error("not an object", "holding", "an object's name", got)

    def make_error(
        self, problem: str, field: str, expected: object = None, got: object = None
    ) -> InputError:
        """Return (without raising) the error for an invalid field."""
        return InputError(
            problem, field=f"terms[{self.name!r}].{field}", expected=expected, got=got
        )

    def _check_positive(self, field: str) -> None:
        """Check that a field is a positive number."""
        where = f"terms[{self.name!r}].{field}"
        expected = "a positive finite number"
        value = check_number(getattr(self, field), where, expected, low=0.0, strict=True)
        object.__setattr__(self, field, value)

    def is_active(self, phase: str, held: Iterable[str]) -> bool:
        """Return whether the term applies in a phase called `phase`, in which `held` are held."""
        if self.during is not None and phase not in self.during:
            return False
        return self.holding is None or self.holding in held

    @property
    def formula(self) -> Formula:
        """The expression as plain data."""
        if not isinstance(self.expression, Formula):
            raise self.make_error("not traced yet", "expression")
        return self.expression


@dataclass(frozen=True)
class Sight:
    """A line of sight from a camera of the robot to a point, which the robot itself may cross.

    Attributes:
        frame: Frame of the robot on which the camera is mounted.
        position: Position of the camera in this frame [m].
        target: Frame of the robot, or link of an object, on which the point is; "": the world.
        point: Position of the point in this frame [m].
        hand: Tool frame of the robot.
        until: Distance between tool frame and point up to which the line does not count [m].
    """

    frame: str
    position: tuple[float, float, float]
    target: str
    point: tuple[float, float, float]
    hand: str
    until: float


@dataclass(frozen=True)
class Constraint(_Term):
    """An expression that is bounded at every waypoint of the chosen phases but their first.

    Attributes:
        name: Name in reports.
        expression: Maps a `State` to a CasADi number or column. Square roots are evaluated at x +
            1e-8 instead of x, so that norms are differentiable at zero; comparisons are expressed
            by the bounds.
        lower, upper: Bounds, one number or one per entry; None: no bound.
        during: Names of phases, e.g. "place cup" (listed in `plan.trajectory.phases`); None: all.
        holding: Object that must be held for the constraint to apply; None: none.
        tolerance: Violation that validation accepts at a waypoint, in the unit of the expression;
            ten times as much between waypoints, where the program has no constraint.
        sight: A line that no link of the robot may cross while the constraint holds, which
            validation checks; see `keep_in_view`.
    """

    _: KW_ONLY
    lower: Numbers | None = None
    upper: Numbers | None = None
    tolerance: float = 1e-3
    sight: Sight | None = None

    def __post_init__(self) -> None:
        self._check()
        self._check_positive("tolerance")
        for field in ("lower", "upper"):
            value = getattr(self, field)
            if value is not None:
                object.__setattr__(self, field, self._check_bound(field, value))
        self.compute_bounds(self.expression.rows if isinstance(self.expression, Formula) else None)

    def _check_bound(self, field: str, value: Any) -> float | tuple[float, ...]:
        where = f"terms[{self.name!r}].{field}"
        expected = "a number or a list of them"
        given = check_array(value, where, expected, problem="not a number")
        impossible = np.inf if field == "lower" else -np.inf
        is_wrong = np.isnan(given) | (given == impossible)
        if given.ndim > 1 or not given.size or is_wrong.any():
            raise self.make_error("no such bound", field, expected, format_value(value))
        return float(given) if given.ndim == 0 else tuple(given.tolist())

    def compute_bounds(self, rows: int | None) -> tuple[Floats, Floats]:
        """Return both bounds, shape (rows,); rows: None: as many as there are bounds.

        Raises:
            InputError: They do not fit the expression, or each other.
        """

        def make_error(problem: str, expected: str) -> InputError:
            got = format_value((self.lower, self.upper))
            return self.make_error(problem, "lower, upper", expected, got)

        given_lower = -np.inf if self.lower is None else self.lower
        given_upper = np.inf if self.upper is None else self.upper
        try:
            if rows is None:
                lower, upper = np.broadcast_arrays(given_lower, given_upper)
            else:
                lower = np.broadcast_to(given_lower, (rows,))
                upper = np.broadcast_to(given_upper, (rows,))
        except ValueError:
            expected = f"one number, or {rows}, like the expression"
            if rows is None:
                expected = "as many lower as upper ones"
            raise make_error("wrong number of bounds", expected) from None
        if not (np.isfinite(lower) | np.isfinite(upper)).all():
            raise make_error("no bound", "at least one of them, finite")
        if (lower > upper).any():
            raise make_error("lower is more than upper", "lower <= upper")
        return lower, upper


@dataclass(frozen=True)
class Cost(_Term):
    """An expression to minimise: `weight` times its sum over the waypoints of the chosen phases.

    The first waypoint of each phase does not count.

    Attributes:
        name: Name in error messages.
        expression: Maps a `State` to a CasADi number; see `Constraint`.
        weight: Weight beside `Options.velocity_weight_*` and the others.
        during, holding: When the cost applies, as for a `Constraint`.
    """

    _: KW_ONLY
    weight: float = 1.0

    def __post_init__(self) -> None:
        self._check()
        self._check_positive("weight")


Term = Constraint | Cost


def trace_terms(scene: Scene, terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return terms with their expressions as plain data, checked against a scene."""
    terms = check_list(terms, "terms", "a list of Constraint and Cost", (Constraint, Cost))
    if not terms:
        return ()
    frames = [*scene.robot.frame_names]
    coordinates = [*scene.robot.coordinates.names]
    for name, placed in scene.objects.items():
        frames += [f"{name}.{link}" for link in placed.object.links]
        coordinates += [f"{name}.{joint}" for joint in placed.object.coordinates.names]
    for term in terms:
        if term.holding is not None and term.holding not in scene.objects:
            field = f"terms[{term.name!r}].holding"
            raise UnknownNameError("object", term.holding, scene.objects, field=field)
    return _trace_all(terms, frames, coordinates)


def trace_terms_without_scene(terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return terms with their expressions as plain data; all names are accepted."""
    terms = check_list(terms, "terms", "a list of Constraint and Cost", (Constraint, Cost))
    return _trace_all(terms, None, None)


def rename_term(term: Term, frames: Mapping[str, str], objects: Mapping[str, str]) -> Term:
    """Return a traced term with other frames, and another object that must be held.

    Args:
        term: Term.
        frames: Name of a frame in its expression → its new name; others keep theirs.
        objects: Name of an object in `holding` → its new name.
    """
    new_frames = [frames.get(name, name) for name in term.formula.frames]
    formula = replace(term.formula, frames=tuple(new_frames))
    holding = term.holding
    if holding is not None:
        holding = objects.get(holding, holding)
    renamed = replace(term, expression=formula, holding=holding)
    if not isinstance(renamed, Constraint) or renamed.sight is None:
        return renamed
    ends = (renamed.sight.frame, renamed.sight.target)
    frame, target = (frames.get(name, name) for name in ends)
    return replace(renamed, sight=replace(renamed.sight, frame=frame, target=target))


def _trace_all(
    terms: Sequence[Term], frames: Sequence[str] | None, coordinates: Sequence[str] | None
) -> tuple[Term, ...]:
    found: list[Term] = []
    for term in terms:
        if any(other.name == term.name for other in found):
            raise InputError(
                "two terms share a name",
                field="terms",
                expected="different names",
                got=format_value(term.name),
            )
        state = State(frames, coordinates, f"terms[{term.name!r}].expression")
        found.append(_trace(term, state))
    return tuple(found)


def _trace(term: Term, state: State) -> Term:
    if isinstance(term.expression, Formula):
        state.check_names(term.expression)
        return term
    try:
        value = term.expression(state)
    except UnknownNameError:
        raise
    except Exception as error:
        raise term.make_error(
            "it cannot be evaluated", "expression", "CasADi operations only", str(error)
        ) from error
    if isinstance(value, int | float | np.ndarray | np.number | ca.DM):
        raise term.make_error(_CONSTANT, "expression", _DEPENDENT, format_value(value))
    if not isinstance(value, ca.SX):
        expected = "a number or a column, e.g. of ca.vertcat"
        got = format_value(value)
        raise term.make_error("not a CasADi expression", "expression", expected, got)
    is_cost = isinstance(term, Cost)
    is_column = value.is_vector() and not value.is_empty()
    if not is_column or (is_cost and not value.is_scalar()):
        expected = "a number" if is_cost else "a number or a column"
        raise term.make_error("wrong shape", "expression", expected, f"shape {value.shape}")
    try:
        formula = state.make_formula(ca.vec(value))
    except RuntimeError as error:
        raise term.make_error(
            "it has symbols of its own", "expression", "only those of its State", str(error)
        ) from error
    if not formula.input_indices:
        raise term.make_error(_CONSTANT, "expression", _DEPENDENT, str(value))
    if formula.has_comparison:
        raise term.make_error(
            "a comparison", "expression", "an expression that lower and upper bound", str(value)
        )
    return replace(term, expression=formula)


def check_terms_active(terms: Iterable[Term], phases: Sequence[tuple[str, Iterable[str]]]) -> None:
    """Check that every term applies in some phase of a task."""
    names = list(dict.fromkeys(name for name, _ in phases))
    for term in terms:
        for name in term.during or ():
            if name not in names:
                raise UnknownNameError("phase", name, names, field=f"terms[{term.name!r}].during")
        if not any(term.is_active(name, held) for name, held in phases):
            held_in_phases = [
                f"{name!r} holds {', '.join(held) or 'nothing'}" for name, held in phases
            ]
            raise term.make_error(
                "never held in these phases",
                "holding",
                expected=", ".join(held_in_phases),
                got=format_value(term.holding),
            )


def term_to_dict(term: Term) -> dict[str, Any]:
    """Return a traced term as plain data, e.g. for a saved plan."""
    return {"term": type(term).__name__, **asdict(term)}


def term_from_dict(data: Mapping[str, Any]) -> Term:
    """Return the term that `term_to_dict` converted to `data`."""
    fields = check_mapping(data, "terms", "a term as data")
    kinds: dict[str, type[Constraint] | type[Cost]] = {"Constraint": Constraint, "Cost": Cost}
    try:
        formula = _formula_from_dict(fields.pop("expression"))
        kind = kinds[fields.pop("term")]
        if fields.get("sight") is not None:
            fields["sight"] = _sight_from_dict(fields["sight"])
        return kind(expression=formula, **fields)
    except (LookupError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(
            "not a saved term",
            field="terms",
            expected="a term written by Plan.save",
            got=str(error),
        ) from error


def _sight_from_dict(data: Any) -> Sight:
    position, point = (check_finite_array(data[name], name) for name in ("position", "point"))
    x, y, z = position.tolist()
    u, v, w = point.tolist()
    hand = str(data["hand"])
    until = check_number(data["until"], "until")
    return Sight(str(data["frame"]), (x, y, z), str(data["target"]), (u, v, w), hand, until)


def _formula_from_dict(data: Any) -> Formula:
    code = list[tuple[str, tuple[int, ...], int, float]]()
    for name, read, written, constant in data["code"]:
        code.append((str(name), tuple(map(int, read)), int(written), float(constant)))
    formula = Formula(
        frames=tuple(data["frames"]),
        coordinates=tuple(data["coordinates"]),
        rows=int(data["rows"]),
        code=tuple(code),
    )
    formula.function  # noqa: B018 - raises an error for an invalid expression
    return formula
