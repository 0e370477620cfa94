"""Defines the options of `vkc-pin plan` that are steps, in the order in which they are given."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from vkc_pin.cli.options import add_option
from vkc_pin.errors import InputError

if TYPE_CHECKING:
    from vkc_pin.world.task.steps import Step


_SETTING = "OBJECT.JOINT=VALUE, e.g. door.hinge=1.2"
_JOINT = "NAME=VALUE, e.g. elbow_joint=1.2"
_THEN = "--then"
_OPTIONS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("--set OBJECT.JOINT=VALUE", "bring a joint to a value [m], [rad]", {}),
    ("--grasp OBJECT[.ATTACHMENT]", "grasp an object", {}),
    (
        "--touch",
        "bring a link of a held object, or of the robot, to a point [m]",
        {"nargs": 4, "metavar": ("FRAME", "X", "Y", "Z")},
    ),
    (
        "--place",
        "put an object down upright at a point [m], or at a pose (with ROLL PITCH YAW [rad])",
        {"nargs": "+", "metavar": ("OBJECT", "NUMBER")},
    ),
    ("--release OBJECT", "release an object", {}),
    (
        "--reach",
        "bring the hand to a pose [m], [rad]",
        {"nargs": 6, "type": float, "metavar": ("X", "Y", "Z", "ROLL", "PITCH", "YAW")},
    ),
    (
        "--go-to",
        "drive the base to a place [m], [rad]",
        {"nargs": 3, "type": float, "metavar": ("X", "Y", "YAW")},
    ),
    ("--joint NAME=VALUE", "bring a joint of the robot to a value [m], [rad]", {}),
    (_THEN, "begin a new step: settings before and after it are two steps", {"nargs": 0}),
)


def add_steps(plan: argparse.ArgumentParser) -> None:
    """Add the options to a parser; each may be repeated."""
    group = plan.add_argument_group("steps, in their order; each may be repeated")
    for form, text, settings in _OPTIONS:
        option = form.partition(" ")[0]
        add_option(group, form, text, action=_AppendStep, dest="steps", const=option, **settings)


class _AppendStep(argparse.Action):
    """Appends option and value to `steps`, which keeps the order of different options."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: str | None = None) -> None:
        namespace.steps = [*(namespace.steps or ()), (self.const, values)]


def make_steps(given: Sequence[tuple[str, Any]]) -> list[Step]:
    """Return the steps of options and their values, in this order.

    Consecutive settings of different joints of one object, or of the robot, become one step;
    `--then` separates them.

    Raises:
        InputError: There are none, or a value has another form.
    """
    steps: list[Step] = []
    for option, group in itertools.groupby(given, key=lambda one: one[0]):
        values = [value for _, value in group]
        if option == "--set":
            steps += parse_settings(values)
        elif option == "--joint":
            steps += _parse_joints(values)
        elif option != _THEN:
            steps += [_MAKERS[option](value) for value in values]
    if not steps:
        expected = ", ".join(form.partition(" ")[0] for form, _, _ in _OPTIONS[:-1])
        raise InputError("nothing to plan", field="plan", expected=f"one of {expected}")
    return steps


def parse_settings(settings: Sequence[str]) -> list[Step]:
    """Return `Actuate` steps of texts "object.joint=value".

    Consecutive settings of different joints of one object become one step.

    Raises:
        InputError: A text has another form.
    """
    from vkc_pin.world.task.steps import Actuate

    steps: list[tuple[str, dict[str, float]]] = []  # objects, with the values of joints
    for text in settings:
        name, equals, value = text.partition("=")
        owner, dot, joint = name.strip().partition(".")
        if not (equals and dot and owner and joint):
            raise InputError("not a setting", field="--set", expected=_SETTING, got=repr(text))
        number = _parse_number(value, "--set", _SETTING, text)
        if not steps or steps[-1][0] != owner or joint in steps[-1][1]:
            steps.append((owner, {}))
        _, joints = steps[-1]
        joints[joint] = number
    return [Actuate(owner, joints) for owner, joints in steps]


def _parse_joints(settings: Sequence[str]) -> list[Step]:
    """Return `Configure` steps of texts "joint=value"; a repeated joint begins a new step."""
    from vkc_pin.world.task.steps import Configure

    steps: list[dict[str, float]] = []
    for text in settings:
        name, equals, value = text.partition("=")
        joint = name.strip()
        if not (equals and joint):
            raise InputError("not a setting", field="--joint", expected=_JOINT, got=repr(text))
        number = _parse_number(value, "--joint", _JOINT, text)
        if not steps or joint in steps[-1]:
            steps.append({})
        steps[-1][joint] = number
    return [Configure(joints) for joints in steps]


def _parse_number(text: str, field: str, expected: str, whole: str) -> float:
    """Parse a number in the text `whole` of an option, `field`."""
    try:
        return float(text)
    except ValueError:
        is_setting = field in ("--set", "--joint")
        problem = "not a number after '='" if is_setting else "not a number"
        raise InputError(problem, field=field, expected=expected, got=repr(whole)) from None


def _make_grasp(value: str) -> Step:
    from vkc_pin.world.task.steps import Grasp

    name, dot, attachment = value.partition(".")
    if not name or (dot and not attachment):
        expected = "OBJECT or OBJECT.ATTACHMENT, e.g. cup.rim"
        raise InputError("not a grasp", field="--grasp", expected=expected, got=repr(value))
    return Grasp(name, attachment or None)


def _make_touch(values: Sequence[str]) -> Step:
    from vkc_pin.world.task.steps import Touch

    frame, *point = values
    expected = "FRAME X Y Z, e.g. stick.tip 1.2 0.3 0.8"
    return Touch(frame, [_parse_number(one, "--touch", expected, one) for one in point])


def _make_place(values: Sequence[str]) -> Step:
    from vkc_pin.world.task.steps import Place

    name, *numbers = values
    expected = "OBJECT X Y Z, or OBJECT X Y Z ROLL PITCH YAW"
    if len(numbers) not in (3, 6):
        got = f"{len(numbers)} numbers after {name!r}"
        raise InputError("not a place", field="--place", expected=expected, got=got)
    return Place(name, [_parse_number(one, "--place", expected, one) for one in numbers])


def _make_release(value: str) -> Step:
    from vkc_pin.world.task.steps import Release

    return Release(value)


def _make_reach(pose: Sequence[float]) -> Step:
    from vkc_pin.world.task.steps import Reach

    return Reach(tuple(pose))


def _make_drive(place: Sequence[float]) -> Step:
    from vkc_pin.world.task.steps import GoTo

    return GoTo(*place)


_MAKERS: dict[str, Callable[[Any], Any]] = {
    "--grasp": _make_grasp,
    "--touch": _make_touch,
    "--place": _make_place,
    "--release": _make_release,
    "--reach": _make_reach,
    "--go-to": _make_drive,
}
