"""Reads and writes motions as CSV tables and as JSON.

A motion is plain data as returned by `Trajectory.to_dict`. Times are in seconds, positions in metres
and radians. The base has three coordinates, x, y and yaw in the world frame.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arguments import check_integer, check_list, check_mapping, check_text
from vkc_pin.world.files.documents import parse_json, read_text
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import write_atomically

__all__ = [
    "GROUPS",
    "LARGEST_MOTION",
    "MOST_COLUMNS",
    "MOST_LINES",
    "infer_robot_size",
    "make_single_phase",
    "read_csv",
    "read_json",
    "select_columns",
    "write_csv",
    "write_json",
]

GROUPS = ("all", "robot", "base", "arm", "objects")
"""Groups of coordinates: all, base and arm, base, arm, or joints of objects."""
LARGEST_MOTION = 20_000_000
"""Largest file of a motion [bytes], for about 30 000 waypoints of 25 coordinates."""
MOST_LINES, MOST_COLUMNS = 200_000, 1000
"""Largest numbers of lines and columns of a table."""
_TIME, _PHASES = (
    "time",
    ("phase", "phase_name", "held"),
)  # the first column of a table, and the last ones
_RATE, _WAYPOINT = " velocity", "waypoint"  # of the columns of a curve
_OPENING = "opening"  # after these, where a gripper opens


def write_csv(
    motion: Mapping[str, Any],
    path: str | Path,
    *,
    joints: str | Sequence[str] = "all",
    units: Mapping[str, str] | None = None,
) -> Path:
    """Write a table, a line a waypoint, whole or not at all; return the path.

    The first line names the columns, with units in brackets where they are known: `time [s]`,
    `base_x [m]`, `base_y [m]`, `base_yaw [rad]`, the arm's joints, the objects' joints, then
    `phase` (counted from 1), `phase_name` and `held`, as JSON, and `opening [m]` of the gripper if
    a phase says what it is, empty where it rests. A waypoint between two phases is in the earlier
    one. Numbers have as many digits as it takes to read back the very same.

    A trajectory with a curve has one line per knot. After the positions come the velocities of the
    same coordinates (`base_x velocity [m/s]` and so on), and then `waypoint`: 1 for a knot that is
    a waypoint, else 0.

    Args:
        motion: What to write.
        path: The file.
        joints: One of `GROUPS`, or names of coordinates in the order wanted.
        units: Coordinate → unit, "m" or "rad"; those of the base need not be given.

    Raises:
        UnknownNameError: There is no such group or coordinate.
    """
    columns, phases = select_columns(motion, joints), motion["phases"]
    x, y, yaw = motion["names"][:3]
    known = {x: "m", y: "m", yaw: "rad"}
    for name, unit in check_mapping(
        {} if units is None else units, "units", "names of coordinates, each with its unit"
    ).items():
        known[name] = check_text(unit, f"units[{name!r}]")
    lines: list[str] = []
    table = csv.writer(
        SimpleNamespace(write=lines.append)
    )  # its lines end with "\r\n", so it puts either of them in quotes
    names = [motion["names"][k] for k in columns]
    opens = [f"{_OPENING} [m]"] if any(phase.get(_OPENING) is not None for phase in phases) else []
    named = [f"{name} [{known[name]}]" if name in known else name for name in names]
    curve = motion.get("curve")
    if curve is not None:
        named += [
            f"{name}{_RATE} [{known[name]}/s]" if name in known else name + _RATE for name in names
        ] + [_WAYPOINT]
    table.writerow([f"{_TIME} [s]", *named, *_PHASES, *opens])
    number = 0
    for moment, waypoint, row, told in _written(motion, columns):
        number += waypoint > phases[number]["last"]
        phase = phases[number]
        held = {
            name: [at, phase["by"][name]] if name in phase["by"] else at
            for name, at in phase["held"].items()
        }
        values = [*(repr(float(value)) for value in row), *told]
        opening = "" if phase.get(_OPENING) is None else repr(float(phase[_OPENING]))
        table.writerow(
            [
                repr(float(moment)),
                *values,
                number + 1,
                phase["name"],
                json.dumps(held),
                *([opening] if opens else []),
            ]
        )
    return write_atomically(
        path, "".join(line.removesuffix("\r\n") + "\n" for line in lines).encode("utf-8")
    )


def _written(
    motion: Mapping[str, Any], columns: Sequence[int]
) -> Iterator[tuple[float, int, list[float], list[str]]]:
    """Yield time, current or next waypoint, numbers and waypoint flag of every line."""
    curve = motion.get("curve")
    if curve is None:
        for k, (moment, row) in enumerate(zip(motion["times"], motion["positions"], strict=True)):
            yield moment, k, [row[column] for column in columns], []
        return
    next_one = 0
    for moment, row, rates in zip(curve["times"], curve["positions"], curve["rates"], strict=True):
        is_one = moment == motion["times"][next_one]
        yield (
            moment,
            next_one,
            [values[column] for values in (row, rates) for column in columns],
            [str(int(is_one))],
        )
        next_one = min(next_one + is_one, len(motion["times"]) - 1)


def read_csv(path: str | Path, *, robot_size: int | None = None) -> dict[str, Any]:
    """Return the motion in a table: what `write_csv` wrote with all of the robot's coordinates in it, or one like it.

    Args:
        path: The file. Without the columns `phase`, `phase_name` and `held`, all of it is one phase
            in which nothing is held.
        robot_size: How many of the coordinates are the robot's; None: those before the first with a
            dot in its name.

    Raises:
        InputError: The file is missing, or something in it does not fit; the error names line and
            column.
    """
    path = check_path(path, "path")
    table = read_text(path, "CSV", LARGEST_MOTION)
    if (many := table.count("\n")) > MOST_LINES:
        raise InputError("too many lines", file=path, expected=f"at most {MOST_LINES}", got=many)
    lines = _lines(table, path)
    header = next(lines, (0, []))[1]
    if len(header) > MOST_COLUMNS:
        raise InputError(
            "too many columns",
            file=path,
            line=1,
            expected=f"at most {MOST_COLUMNS}",
            got=len(header),
        )
    header = [re.sub(r" \[(s|m|rad|m/s|rad/s)\]$", "", name) for name in header]
    if not header:
        raise InputError("an empty file", file=path, expected="a table with a line of names")
    if header[0] != _TIME:
        raise InputError(
            "not a table of waypoints",
            file=path,
            line=1,
            field="first column",
            expected=_TIME,
            got=format_value(header[0]),
        )
    opens = tuple(header[-4:]) == (*_PHASES, _OPENING)
    told = opens or tuple(header[-3:]) == _PHASES
    last = len(header) - (len(_PHASES) + opens if told else 0)
    names, curved = header[1:last], header[last - 1] == _WAYPOINT and last > 1
    if curved:
        half = (len(names) - 1) // 2
        names, rates = names[:half], names[half:-1]
        if rates != [name + _RATE for name in names]:
            expected = ", ".join(name + _RATE for name in names)
            raise InputError(
                "not the velocities of its coordinates",
                file=path,
                line=1,
                expected=expected,
                got=", ".join(rates),
            )
    rows: list[list[float]] = []
    knots: list[list[float]] = []
    phases: list[dict[str, Any]] = []
    for number, cells in lines:
        if not cells:
            continue
        if len(cells) != len(header):
            raise InputError(
                "wrong number of columns",
                file=path,
                line=number,
                expected=len(header),
                got=len(cells),
            )
        row = [
            _number(cell, path, number, name)
            for cell, name in zip(cells[:last], header, strict=False)
        ]
        if curved:
            knots.append(row)
            if not row[-1]:
                continue
        rows.append(row[: len(names) + 1])
        if told:
            opening = _number(cells[-1], path, number, _OPENING) if opens and cells[-1] else None
            _add_phase(phases, cells[last : last + 3], opening, len(rows) - 1, path, number)
    if not told and len(rows) > 1:
        phases = [make_single_phase(len(rows))]
    own = slice(1, len(names) + 1)
    curve = {
        "times": [knot[0] for knot in knots],
        "positions": [knot[own] for knot in knots],
        "rates": [knot[own.stop : -1] for knot in knots],
    }
    return {
        **({"curve": curve} if curved else {}),
        "names": names,
        "times": [row[0] for row in rows],
        "positions": [row[1:] for row in rows],
        "robot_size": infer_robot_size(names)
        if robot_size is None
        else check_integer(robot_size, "robot_size", low=3),
        "phases": phases,
    }


def write_json(motion: Mapping[str, Any], path: str | Path) -> Path:
    """Write a motion atomically as JSON; return the path."""
    return write_atomically(path, (json.dumps(motion, indent=1) + "\n").encode("utf-8"))


def read_json(path: str | Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: The file is missing, is no JSON, or is larger than a motion can be; the error
            names the line.
    """
    path = check_path(path, "path")
    return parse_json(read_text(path, "JSON", LARGEST_MOTION), path)


def select_columns(motion: Mapping[str, Any], joints: str | Sequence[str]) -> list[int]:
    """Select columns of a motion by one of `GROUPS`, or by names in the wanted order.

    Raises:
        UnknownNameError: There is no such group or coordinate.
        InputError: There is no name, or one occurs twice.
    """
    known, robot, size = motion["names"], motion["robot_size"], len(motion["names"])
    groups = {
        "all": (0, size),
        "robot": (0, robot),
        "base": (0, 3),
        "arm": (3, robot),
        "objects": (robot, size),
    }
    if isinstance(joints, str):
        if joints not in groups:
            raise UnknownNameError("group of joints", joints, GROUPS, field="joints")
        return list(range(*groups[joints]))
    names = check_list(joints, "joints", f"one of {', '.join(GROUPS)}, or a list of names", str)
    if not names:
        raise InputError(
            "no joints",
            field="joints",
            expected=f"one of {', '.join(GROUPS)}, or at least one name",
            got="none",
        )
    for k, name in enumerate(names):
        if name not in known:
            raise UnknownNameError("coordinate", name, known, field=f"joints[{k}]")
        if name in names[:k]:
            raise InputError("a name occurs twice", field=f"joints[{k}]", got=name)
    return [known.index(name) for name in names]


def infer_robot_size(names: Sequence[str]) -> int:
    """Infer the number of robot coordinates: those before the first name with a dot."""
    return next((k for k, name in enumerate(names) if "." in str(name)), len(names))


def make_single_phase(waypoints: int) -> dict[str, Any]:
    """Make a single phase without holds for a whole motion."""
    return {"name": "motion", "first": 0, "last": waypoints - 1, "held": {}, "by": {}}


def _lines(text: str, path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of every line of a table."""
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        for cells in reader:
            yield reader.line_num, cells
    except csv.Error as error:
        raise InputError("not a table", file=path, line=reader.line_num, got=str(error)) from None


def _number(cell: str, path: Path, line: int, column: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(
            "not a number",
            file=path,
            line=line,
            field=column,
            expected="a finite number",
            got=format_value(cell),
        )
    return value


def _add_phase(
    phases: list[dict[str, Any]],
    cells: Sequence[str],
    opening: float | None,
    row: int,
    path: Path,
    line: int,
) -> None:
    """Parse a line's phase cells (number, name, holds) and add or extend the phase."""
    number, name, held = cells
    expected = f"{len(phases)} or {len(phases) + 1}" if phases else "1"
    if number not in expected.split(" or "):
        raise InputError(
            "not the next phase",
            file=path,
            line=line,
            field="phase",
            expected=expected,
            got=format_value(number),
        )
    if int(number) == len(phases):
        phases[-1]["last"] = row
        return
    try:
        found = json.loads(held)
        at = {
            thing: where if isinstance(where, str) else where[0] for thing, where in found.items()
        }
        by = {thing: where[1] for thing, where in found.items() if not isinstance(where, str)}
    except (ValueError, AttributeError, TypeError, LookupError, RecursionError):
        wanted = 'JSON such as {"door": "handle"}'
        raise InputError(
            "not what is held",
            file=path,
            line=line,
            field="held",
            expected=wanted,
            got=format_value(held),
        ) from None
    stands = {} if opening is None else {_OPENING: opening}
    phases.append(
        {"name": name, "first": max(row - 1, 0), "last": row, "held": at, "by": by, **stands}
    )
