"""Holds: what depends on what, and which descriptions make no sense."""

from __future__ import annotations

import itertools

import pytest

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.scene.hold import Hold, holds_of, in_order

STICK = Hold("stick", "grip")
BALL = Hold("ball", "pull", STICK, "tip")
FLY = Hold("fly", "leg", BALL, "ball")


def test_the_tool_and_what_is_held_through_something() -> None:
    assert holds_of({}, {}) == ()
    assert holds_of({"door": "handle", "drawer": "knob"}, {}) == (Hold("door", "handle"), Hold("drawer", "knob"))
    assert (STICK.by, STICK.link, STICK.frame) == (None, None, None)
    assert (BALL.by, BALL.link, BALL.frame) == (STICK, "tip", "stick.tip")
    assert [str(hold) for hold in (STICK, BALL, FLY)] == ["stick.grip", "ball.pull by stick.tip", "fly.leg by ball.ball"]


@pytest.mark.parametrize("order", list(itertools.permutations(["stick", "ball", "fly", "door"])))
def test_each_follows_the_one_it_depends_on(order: tuple[str, ...]) -> None:
    attachments = {"stick": "grip", "ball": "pull", "fly": "leg", "door": "handle"}
    found = holds_of({name: attachments[name] for name in order}, {"fly": "ball.ball", "ball": "stick.tip"})
    assert sorted(found, key=str) == sorted([STICK, BALL, FLY, Hold("door", "handle")], key=str)
    assert found.index(STICK) < found.index(BALL) < found.index(FLY)


def test_equal_holds_are_one_key() -> None:
    again = Hold("ball", "pull", Hold("stick", "grip"), "tip")
    assert again == BALL
    assert hash(again) == hash(BALL)
    assert Hold("ball", "pull") != BALL
    assert Hold("ball", "pull", STICK, "stick") != BALL
    assert Hold("ball", "pull", Hold("stick", "end"), "tip") != BALL


@pytest.mark.parametrize(
    ("held", "by"),
    [
        ({}, {}),
        ({"stick": "grip"}, {}),
        ({"fly": "leg", "stick": "grip", "ball": "pull"}, {"fly": "ball.ball", "ball": "stick.tip"}),
        ({"ball": "pull", "fly": "leg", "stick": "grip"}, {"fly": "stick.tip", "ball": "stick.tip"}),
    ],
)
def test_mappings_round_trip(held: dict[str, str], by: dict[str, str]) -> None:
    found = holds_of(held, by)
    assert {hold.object: hold.attachment for hold in found} == held
    assert {hold.object: hold.frame for hold in found if hold.by} == by
    assert holds_of({hold.object: hold.attachment for hold in found}, by) == in_order(iter(found)) == found


def test_values_do_not_make_another_hold() -> None:
    (again,) = holds_of({"stick": "grip"}, at={"stick": [0.1, 2]})
    assert (again, hash(again), again.at, STICK.at) == (STICK, hash(STICK), (0.1, 2.0), ())


def test_a_hold_comes_after_the_one_it_depends_on() -> None:
    for holds in ((BALL,), (BALL, STICK), (STICK, FLY), (Hold("stick", "end"), BALL)):
        with pytest.raises(InputError, match="not held before"):
            in_order(holds)


@pytest.mark.parametrize(
    ("by", "got"),
    [
        ({"ball": "ball.ball"}, "ball"),
        ({"ball": "stick.tip", "stick": "ball.ball"}, "ball, stick"),
        ({"ball": "fly.leg", "fly": "stick.tip", "stick": "ball.ball"}, "ball, fly, stick"),
    ],
)
def test_nothing_holds_itself_up(by: dict[str, str], got: str) -> None:
    with pytest.raises(InputError, match="in a circle") as caught:
        holds_of({"stick": "grip", "ball": "pull", "fly": "leg", "door": "handle"}, by)
    assert (caught.value.field, caught.value.got) == ("by", got)


@pytest.mark.parametrize("frame", ["tip", "stick.", "stick", "", None, 3])
def test_what_is_no_link_of_an_object(frame: object) -> None:
    with pytest.raises(InputError, match="not a link of an object") as caught:
        holds_of({"stick": "grip", "ball": "pull"}, {"ball": frame})  # type: ignore[dict-item]
    assert caught.value.field == "by"


def test_what_is_not_held_holds_nothing() -> None:
    with pytest.raises(UnknownNameError) as caught:
        holds_of({"stick": "grip", "ball": "pull"}, {"ball": "stik.tip"})
    assert (caught.value.field, caught.value.nearest) == ("by", "stick")
