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
from typing import Any, NamedTuple

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arguments import check_integer, check_list, check_mapping, check_text
from vkc_pin.world.files.documents import parse_json, read_text
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import write_atomically

GROUPS = ("all", "robot", "base", "arm", "objects")
"""Groups of coordinates: all, base and arm, base, arm, or joints of objects."""
_MAX_BYTES = 20_000_000  # of a file: about 30 000 waypoints of 25 coordinates
_MAX_LINES = 200_000
_MAX_COLUMNS = 1000
_TIME = "time"  # first column of a table
_PHASES = ("phase", "phase_name", "held")  # last columns of a table
# Additional columns of a curve: ends of the names of velocities, and name of the last column
_RATE = " velocity"
_WAYPOINT = "waypoint"
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
    columns = select_columns(motion, joints)
    known_units = dict(zip(motion["names"], ("m", "m", "rad"), strict=False))
    expected = "names of coordinates, each with its unit"
    for name, unit in check_mapping({} if units is None else units, "units", expected).items():
        known_units[name] = check_text(unit, f"units[{name!r}]")
    phases = motion["phases"]
    has_openings = any(phase.get(_OPENING) is not None for phase in phases)
    header = [f"{_TIME} [s]"]
    header += _name_columns(motion, columns, known_units)
    header += _PHASES
    if has_openings:
        header.append(f"{_OPENING} [m]")
    lines: list[str] = []
    # The writer ends lines with "\r\n", so that it quotes names with either character.
    table = csv.writer(SimpleNamespace(write=lines.append))
    table.writerow(header)
    number = 0
    for time, waypoint, values in _list_rows(motion, columns):
        if waypoint > phases[number]["last"]:
            number += 1
        phase = phases[number]
        cells = [repr(float(time)), *values, number + 1, phase["name"], _format_holds(phase)]
        if has_openings:
            opening = phase.get(_OPENING)
            cells.append("" if opening is None else repr(float(opening)))
        table.writerow(cells)
    text = "".join(line.removesuffix("\r\n") + "\n" for line in lines)
    return write_atomically(path, text.encode("utf-8"))


def _name_columns(
    motion: Mapping[str, Any], columns: Sequence[int], units: Mapping[str, str]
) -> list[str]:
    """Return the names of columns of coordinates, with their units where they are known."""
    names = [motion["names"][k] for k in columns]
    header = [f"{name} [{units[name]}]" if name in units else name for name in names]
    if motion.get("curve") is not None:
        for name in names:
            unit = f" [{units[name]}/s]" if name in units else ""
            header.append(name + _RATE + unit)
        header.append(_WAYPOINT)
    return header


def _format_holds(phase: Mapping[str, Any]) -> str:
    """Return the holds of a phase as JSON; see `_parse_holds`."""
    held = dict(phase["held"])
    deviation = phase.get("deviation") or {}
    for name in phase["by"].keys() | deviation.keys():
        hold = [held[name], phase["by"].get(name)]
        if name in deviation:
            hold.append(deviation[name])
        held[name] = hold
    return json.dumps(held)


def _list_rows(
    motion: Mapping[str, Any], columns: Sequence[int]
) -> Iterator[tuple[float, int, list[str]]]:
    """Yield time, present or next waypoint, and cells of every line."""
    curve = motion.get("curve")
    source = motion if curve is None else curve
    last = len(motion["times"]) - 1
    waypoint = 0
    for k, (time, row) in enumerate(zip(source["times"], source["positions"], strict=True)):
        cells = [repr(float(row[column])) for column in columns]
        is_waypoint = time == motion["times"][waypoint]
        if curve is not None:
            rates = curve["rates"][k]
            cells += [repr(float(rates[column])) for column in columns]
            cells.append("1" if is_waypoint else "0")
        yield time, waypoint, cells
        if is_waypoint and waypoint < last:
            waypoint += 1


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
    count = table.count("\n")
    if count > _MAX_LINES:
        raise InputError("too many lines", file=path, expected=f"at most {_MAX_LINES}", got=count)
    lines = _read_lines(table, path)
    _, first_line = next(lines, (0, []))
    header = _check_header(first_line, path)
    layout = _find_layout(header, path)
    names = layout.names
    rows: list[list[float]] = []
    knots: list[list[float]] = []
    phases: list[dict[str, Any]] = []
    for line, cells in lines:
        if not cells:
            continue
        if len(cells) != len(header):
            raise InputError(
                "wrong number of columns",
                file=path,
                line=line,
                expected=len(header),
                got=len(cells),
            )
        row = list[float]()
        for cell, name in zip(cells[: layout.number_count], header, strict=False):
            row.append(_parse_number(cell, path, line, name))
        if layout.has_phases:
            # This row is the next waypoint, or leads there.
            _add_phase(phases, cells[layout.number_count :], len(rows), path, line)
        knots.append(row)
        if not layout.is_marked or row[-1]:
            rows.append(row)
    if not layout.has_phases and len(rows) > 1:
        phases = [make_single_phase(len(rows))]
    if robot_size is None:
        robot_size = infer_robot_size(names, file=path, line=1)
    else:
        robot_size = check_integer(robot_size, "robot_size", low=3)
    # Columns of a row: time, positions, and rates of a curve.
    first_rate = 1 + len(names)
    motion = {
        "names": names,
        "times": [row[0] for row in rows],
        "positions": [row[1:first_rate] for row in rows],
        "robot_size": robot_size,
        "phases": phases,
    }
    if layout.is_curve:
        motion["curve"] = {
            "times": [knot[0] for knot in knots],
            "positions": [knot[1:first_rate] for knot in knots],
            "rates": [knot[first_rate : first_rate + len(names)] for knot in knots],
        }
    return motion


class _Layout(NamedTuple):
    """Columns of a table: numbers, then the cells of a phase.

    Attributes:
        names: Names of the coordinates.
        number_count: Number of columns with numbers.
        has_phases: Whether cells of a phase follow: its number, name and holds, and an opening.
        is_curve: Whether positions are followed by velocities.
        is_marked: Whether the last number tells waypoints from other knots.
    """

    names: list[str]
    number_count: int
    has_phases: bool
    is_curve: bool
    is_marked: bool


def _find_layout(header: list[str], path: Path) -> _Layout:
    """Return the columns of a table with a header."""
    has_openings = tuple(header[-4:]) == (*_PHASES, _OPENING)
    has_phases = has_openings or tuple(header[-3:]) == _PHASES
    number_count = len(header)
    if has_phases:
        number_count -= len(_PHASES)
    if has_openings:
        number_count -= 1
    names = header[1:number_count]
    is_curve = _has_rates(names)
    is_marked = is_curve and names[-1] == _WAYPOINT
    if is_curve:
        names = _check_rate_columns(names[:-1] if is_marked else names, path)
    return _Layout(names, number_count, has_phases, is_curve, is_marked)


def _check_header(cells: list[str], path: Path) -> list[str]:
    """Return the column names of a table without their units."""
    if len(cells) > _MAX_COLUMNS:
        expected = f"at most {_MAX_COLUMNS}"
        raise InputError("too many columns", file=path, line=1, expected=expected, got=len(cells))
    header = [re.sub(r" \[(s|m|rad|m/s|rad/s)\]$", "", name) for name in cells]
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
    return header


def _has_rates(columns: list[str]) -> bool:
    """Return whether columns have velocities of coordinates, as of a curve."""
    is_marked = columns[-1:] == [_WAYPOINT] and any(name.endswith(_RATE) for name in columns)
    return is_marked or any(name == columns[0] + _RATE for name in columns)


def _check_rate_columns(columns: list[str], path: Path) -> list[str]:
    """Return the coordinates of a curve's columns, which are followed by their velocities."""
    half = len(columns) // 2
    names = columns[:half]
    rates = columns[half:]
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
    text = json.dumps(motion, indent=1) + "\n"
    return write_atomically(path, text.encode("utf-8"))


def read_json(path: str | Path) -> Any:
    """Read a JSON file."""
    path = check_path(path, "path")
    return parse_json(read_text(path, "JSON", _MAX_BYTES), path)


def select_columns(motion: Mapping[str, Any], joints: str | Sequence[str]) -> list[int]:
    """Select columns of a motion by one of `GROUPS`, or by names in the wanted order."""
    known = motion["names"]
    size = len(known)
    robot_size = motion["robot_size"]
    groups = {
        "all": range(size),
        "robot": range(robot_size),
        "base": range(3),
        "arm": range(3, robot_size),
        "objects": range(robot_size, size),
    }
    if isinstance(joints, str):
        if joints not in groups:
            raise UnknownNameError("group of joints", joints, GROUPS, field="joints")
        return list(groups[joints])
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
    size = len(names)
    for k, name in enumerate(names):
        has_dot = "." in str(name)
        if has_dot and size == len(names):
            size = k
        if not has_dot and k > size:
            first = format_value(names[size])
            expected = f"joints of the robot before those of objects such as {first}, or the "
            expected += "argument robot_size"
            raise InputError("not in order", expected=expected, got=format_value(name), **where)
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
    row: int,
    path: Path,
    line: int,
) -> None:
    """Parse a line's phase cells (number, name, holds, opening) and add or extend the phase.

    A waypoint between two phases belongs to the earlier one. All lines of a phase must agree.
    """
    number, name, held, *openings = cells
    stated_openings = {}
    for opening in openings:
        if opening:
            stated_openings[_OPENING] = _parse_number(opening, path, line, _OPENING)
    expected_numbers = [str(len(phases)), str(len(phases) + 1)] if phases else ["1"]
    if number not in expected_numbers:
        raise InputError(
            "not the next phase",
            file=path,
            line=line,
            field="phase",
            expected=" or ".join(expected_numbers),
            got=format_value(number),
        )
    details = {"name": name, **_parse_holds(held, path, line), **stated_openings}
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
    attachments = {}
    by = {}
    deviation = {}
    try:
        for name, hold in json.loads(held).items():
            # Attachment, grasping frame and deviation; the attachment alone without the others.
            row = [hold, None] if isinstance(hold, str) else hold
            attachments[name] = row[0]
            if row[1] is not None:
                by[name] = row[1]
            if len(row) > 2:
                deviation[name] = row[2]
    except (ValueError, AttributeError, TypeError, LookupError, RecursionError):
        raise InputError(
            "not the held objects",
            file=path,
            line=line,
            field="held",
            expected='JSON such as {"door": "handle"}',
            got=format_value(held),
        ) from None
    data = {"held": attachments, "by": by}
    if deviation:
        data["deviation"] = deviation
    return data
