"""Reads SRDF files: pairs of links that may touch, and named configurations."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from vkc_pin.errors import UnknownNameError
from vkc_pin.files.xml import read_xml

__all__ = ["Srdf", "read_srdf"]


@dataclass(frozen=True)
class Srdf:
    """What an SRDF says.

    Attributes:
        allowed: Pairs of links that need not be kept apart, each sorted, with the reason.
        states: Name → joint → position, [m] or [rad].
    """

    allowed: dict[tuple[str, str], str]
    states: dict[str, dict[str, float]]

    def state(self, joints: Collection[str]) -> dict[str, float]:
        """Return the state that covers all `joints`: one called home, default or rest, else the first; {} if none does."""
        fitting = {name: state for name, state in self.states.items() if set(joints) <= set(state)}
        for name in ("home", "default", "rest"):
            if name in fitting:
                return fitting[name]
        return next(iter(fitting.values()), {})


def read_srdf(path: str | Path, *, links: Collection[str]) -> Srdf:
    """Read an SRDF file.

    Args:
        path: The file.
        links: The links of the robot it belongs to.

    Raises:
        InputError: It cannot be read or is no SRDF.
        UnknownNameError: It names a link that the robot does not have.
    """
    text, root = read_xml(path, "SRDF")
    allowed = {}
    for element in root.iter("disable_collisions"):
        pair = [element.get(key, "") for key in ("link1", "link2")]
        for name in pair:
            if name not in links:
                line = next((number for number, line in enumerate(text.splitlines(), 1) if f'"{name}"' in line), None)
                raise UnknownNameError("link", name, links, file=path, line=line, field="disable_collisions")
        first, second = sorted(pair)
        allowed[first, second] = element.get("reason", "")
    states: dict[str, dict[str, float]] = {}
    for element in root.iter("group_state"):
        state = states.setdefault(element.get("name", ""), {})
        for joint in element.findall("joint"):
            try:
                state[joint.get("name", "")] = float(joint.get("value", ""))
            except ValueError:
                continue  # joints of several coordinates: not ours
    return Srdf(allowed, states)
