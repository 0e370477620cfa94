"""Reads and writes motions as CSV tables and as JSON.

A motion is plain data as returned by `Trajectory.to_dict`. Times are in seconds, positions in
metres and radians. The base has three coordinates, x, y and yaw in the world frame.
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

GROUPS = ("all", "robot", "base", "arm", "objects")
"""Groups of coordinates: all, base and arm, base, arm, or joints of objects."""
_MAX_BYTES = 20_000_000  # of a file: about 30 000 waypoints of 25 coordinates
_MAX_LINES, _MAX_COLUMNS = 200_000, 1000
_TIME, _PHASES = "time", ("phase", "phase_name", "held")  # first and last columns of a table
_RATE, _WAYPOINT = " velocity", "waypoint"  # additional columns of a curve
_BASE = ("base_x", "base_y", "base_yaw")  # of any robot
_OPENING = "opening"  # additional last column if a phase states a gripper opening


def write_csv(
    motion: Mapping[str, Any],
    path: str | Path,
    *,
    joints: str | Sequence[str] = "all",
    units: Mapping[str, str] | None = None,
) -> Path:
    """Write a table with one line per waypoint atomically; return the path.

    The first line names the columns, with units where they are known: `time [s]`, `base_x [m]`,
    `base_y [m]`, `base_yaw [rad]`, the arm's joints, the objects' joints, `phase` (from 1),
    `phase_name`, `held` (JSON) and, if a phase states it, `opening [m]` of the gripper. A waypoint
    between two phases belongs to the earlier one. Numbers are exact.

    A trajectory with a curve has one line per knot. After the positions come the velocities of the
    same coordinates (`base_x velocity [m/s]` and so on), and `waypoint`: 1 for a knot that is a
    waypoint, else 0.

    Args:
        motion: Motion.
        path: File.
        joints: One of `GROUPS`, or names of coordinates in the wanted order.
        units: Coordinate → unit, "m" or "rad"; units of the base are known.

    Raises:
        UnknownNameError: There is no such group or coordinate.
    """
    columns, phases = select_columns(motion, joints), motion["phases"]
    known = dict(zip(motion["names"], ("m", "m", "rad"), strict=False))
    expected = "names of coordinates, each with its unit"
    for name, unit in check_mapping({} if units is None else units, "units", expected).items():
        known[name] = check_text(unit, f"units[{name!r}]")
    lines: list[str] = []
    # The writer ends lines with "\r\n", so that it quotes names with either character.
    table = csv.writer(SimpleNamespace(write=lines.append))
    names = [motion["names"][k] for k in columns]
    header = [f"{name} [{known[name]}]" if name in known else name for name in names]
    if motion.get("curve") is not None:
        header += [
            name + _RATE + (f" [{known[name]}/s]" if name in known else "") for name in names
        ]
        header.append(_WAYPOINT)
    has_openings = any(phase.get(_OPENING) is not None for phase in phases)
    openings = [f"{_OPENING} [m]"] if has_openings else []
    table.writerow([f"{_TIME} [s]", *header, *_PHASES, *openings])
    number = 0
    for time, waypoint, values in _list_rows(motion, columns):
        number += waypoint > phases[number]["last"]
        phase = phases[number]
        held, deviation = dict(phase["held"]), phase.get("deviation") or {}
        for name in phase["by"].keys() | deviation.keys():
            own = [deviation[name]] if name in deviation else []
            held[name] = [held[name], phase["by"].get(name), *own]
        if has_openings:
            opening = phase.get(_OPENING)
            openings = ["" if opening is None else repr(float(opening))]
        cells = [number + 1, phase["name"], json.dumps(held), *openings]
        table.writerow([repr(float(time)), *values, *cells])
    text = "".join(line.removesuffix("\r\n") + "\n" for line in lines)
    return write_atomically(path, text.encode("utf-8"))


def _list_rows(
    motion: Mapping[str, Any], columns: Sequence[int]
) -> Iterator[tuple[float, int, list[str]]]:
    """Yield time, present or next waypoint, and cells of every line."""
    waypoint, curve = 0, motion.get("curve")
    source = motion if curve is None else curve
    for k, (time, row) in enumerate(zip(source["times"], source["positions"], strict=True)):
        cells = [repr(float(row[column])) for column in columns]
        is_waypoint = time == motion["times"][waypoint]
        if curve is not None:
            cells += [repr(float(curve["rates"][k][column])) for column in columns]
            cells.append(str(int(is_waypoint)))
        yield time, waypoint, cells
        waypoint = min(waypoint + is_waypoint, len(motion["times"]) - 1)


def read_csv(path: str | Path, *, robot_size: int | None = None) -> dict[str, Any]:
    """Return the motion in a table like those of `write_csv`, with all robot coordinates.

    Args:
        path: File. Without the columns `phase`, `phase_name` and `held`, the motion is one phase
            without holds.
        robot_size: Number of robot coordinates. Default: those before the first with a dot in its
            name.
    """
    path = check_path(path, "path")
    table = read_text(path, "CSV", _MAX_BYTES)
    if (many := table.count("\n")) > _MAX_LINES:
        raise InputError("too many lines", file=path, expected=f"at most {_MAX_LINES}", got=many)
    lines = _read_lines(table, path)
    header = _check_header(next(lines, (0, []))[1], path)
    has_openings = tuple(header[-4:]) == (*_PHASES, _OPENING)
    has_phases = has_openings or tuple(header[-3:]) == _PHASES
    last = len(header) - (len(_PHASES) + has_openings if has_phases else 0)
    names, is_curve = header[1:last], _has_rates(header[1:last])
    is_marked = is_curve and names[-1] == _WAYPOINT
    if is_curve:
        names = _check_rate_columns(names[: len(names) - is_marked], path)
    own = slice(1, len(names) + 1)
    rows: list[list[float]] = []
    knots: list[list[float]] = []
    phases: list[dict[str, Any]] = []
    for number, cells in lines:
        if not cells:
            continue
        if len(cells) != len(header):
            problem, count = "wrong number of columns", len(header)
            raise InputError(problem, file=path, line=number, expected=count, got=len(cells))
        row = [
            _parse_number(cell, path, number, name)
            for cell, name in zip(cells[:last], header, strict=False)
        ]
        if has_phases:
            opening = cells[-1] if has_openings else ""
            stated = {_OPENING: _parse_number(opening, path, number, _OPENING)} if opening else {}
            # This row is the next waypoint, or leads there.
            _add_phase(phases, cells[last : last + 3], stated, len(rows), path, number)
        knots.append(row)
        if not is_marked or row[-1]:
            rows.append(row)
    if not has_phases and len(rows) > 1:
        phases = [make_single_phase(len(rows))]
    if robot_size is None:
        robot_size = infer_robot_size(names, file=path, line=1)
    else:
        robot_size = check_integer(robot_size, "robot_size", low=3)
    motion = {
        "names": names,
        "times": [row[0] for row in rows],
        "positions": [row[own] for row in rows],
        "robot_size": robot_size,
        "phases": phases,
    }
    if is_curve:
        motion["curve"] = {
            "times": [knot[0] for knot in knots],
            "positions": [knot[own] for knot in knots],
            "rates": [knot[own.stop : own.stop + len(names)] for knot in knots],
        }
    return motion


def _check_header(cells: list[str], path: Path) -> list[str]:
    """Return the column names of a table without their units."""
    if len(cells) > _MAX_COLUMNS:
        most = f"at most {_MAX_COLUMNS}"
        raise InputError("too many columns", file=path, line=1, expected=most, got=len(cells))
    header = [re.sub(r" \[(s|m|rad|m/s|rad/s)\]$", "", name) for name in cells]
    if not header:
        raise InputError("an empty file", file=path, expected="a table with a line of names")
    if header[0] != _TIME:
        problem, got = "not a table of waypoints", format_value(header[0])
        raise InputError(problem, file=path, line=1, field="first column", expected=_TIME, got=got)
    return header


def _has_rates(columns: list[str]) -> bool:
    """Return whether columns have velocities of coordinates, as of a curve."""
    is_marked = columns[-1:] == [_WAYPOINT] and any(name.endswith(_RATE) for name in columns)
    return is_marked or any(name == columns[0] + _RATE for name in columns)


def _check_rate_columns(columns: list[str], path: Path) -> list[str]:
    """Return the coordinates of a curve's columns, which are followed by their velocities."""
    half = len(columns) // 2
    names, rates = columns[:half], columns[half:]
    expected = [name + _RATE for name in names]
    if rates != expected:
        raise InputError(
            "not the velocities of its coordinates",
            file=path,
            line=1,
            expected=", ".join(expected),
            got=", ".join(rates),
        )
    return names


def write_json(motion: Mapping[str, Any], path: str | Path) -> Path:
    """Write a motion atomically as JSON; return the path."""
    return write_atomically(path, (json.dumps(motion, indent=1) + "\n").encode("utf-8"))


def read_json(path: str | Path) -> Any:
    """Read a JSON file."""
    path = check_path(path, "path")
    return parse_json(read_text(path, "JSON", _MAX_BYTES), path)


def select_columns(motion: Mapping[str, Any], joints: str | Sequence[str]) -> list[int]:
    """Select columns of a motion by one of `GROUPS`, or by names in the wanted order."""
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


def infer_robot_size(names: Sequence[str], **where: Any) -> int:
    """Infer the number of robot coordinates: those before the first name with a dot.

    Args:
        names: Names of all coordinates.
        where: File, and line or field, for the error.

    Raises:
        InputError: The first ones are not those of the base, as in a motion of an arm alone, or
            joints of objects come before others, as in alphabetical order.
    """
    if tuple(names[:3]) != _BASE:
        expected = f"{', '.join(_BASE)} first, or the argument robot_size"
        raise InputError("no base coordinates", expected=expected, got=tuple(names[:3]), **where)
    has_dot = ["." in str(name) for name in names]
    size = has_dot.index(True) if True in has_dot else len(names)
    if not all(has_dot[size:]):
        first, late = names[size], names[size + has_dot[size:].index(False)]
        expected = f"joints of the robot before those of objects such as {format_value(first)}, "
        expected += "or the argument robot_size"
        raise InputError("not in order", expected=expected, got=format_value(late), **where)
    return size


def make_single_phase(waypoints: int) -> dict[str, Any]:
    """Make a single phase without holds for a whole motion."""
    return {"name": "motion", "first": 0, "last": waypoints - 1, "held": {}, "by": {}}


def _read_lines(text: str, path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of every line of a table."""
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        for cells in reader:
            yield reader.line_num, cells
    except csv.Error as error:
        raise InputError("not a table", file=path, line=reader.line_num, got=str(error)) from None


def _parse_number(cell: str, path: Path, line: int, column: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        expected, got = "a finite number", format_value(cell)
        raise InputError(
            "not a number", file=path, line=line, field=column, expected=expected, got=got
        )
    return value


def _add_phase(
    phases: list[dict[str, Any]],
    cells: Sequence[str],
    opening: dict[str, float],
    row: int,
    path: Path,
    line: int,
) -> None:
    """Parse a line's phase cells (number, name, holds) and add or extend the phase.

    A waypoint between two phases belongs to the earlier one. All lines of a phase must agree.
    """
    number, name, held = cells
    expected = f"{len(phases)} or {len(phases) + 1}" if phases else "1"
    if number not in expected.split(" or "):
        problem, got = "not the next phase", format_value(number)
        raise InputError(problem, file=path, line=line, field="phase", expected=expected, got=got)
    details = {"name": name, **_parse_holds(held, path, line), **opening}
    if int(number) > len(phases):
        phases.append({**details, "first": max(row - 1, 0), "last": row})
        return
    phases[-1]["last"] = row
    known = {key: value for key, value in phases[-1].items() if key not in ("first", "last")}
    if details != known:
        raise InputError(
            f"phase {number} is another one in the lines before",
            file=path,
            line=line,
            field="phase",
            expected=f"{format_value(known)}, or the number {int(number) + 1}",
            got=format_value(details),
        )


def _parse_holds(held: str, path: Path, line: int) -> dict[str, Any]:
    """Return the holds of a phase as in a motion's data."""
    try:
        items = json.loads(held).items()
        rows = {name: [hold, None] if isinstance(hold, str) else hold for name, hold in items}
        at = {name: row[0] for name, row in rows.items()}
        by = {name: row[1] for name, row in rows.items() if row[1] is not None}
        deviation = {name: row[2] for name, row in rows.items() if len(row) > 2}
    except (ValueError, AttributeError, TypeError, LookupError, RecursionError):
        problem, expected = "not the held objects", 'JSON such as {"door": "handle"}'
        raise InputError(
            problem,
            file=path,
            line=line,
            field="held",
            expected=expected,
            got=format_value(held),
        ) from None
    return {"held": at, "by": by, **({"deviation": deviation} if deviation else {})}
