"""Tests the moments at which transport begins or ends, with made-up phases."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np

from vkc_pin.planning.chain import easing as module
from vkc_pin.planning.chain.easing import REDUCED_MARGIN_RATIO, _find_lift_and_place_moments
from vkc_pin.world.scene.hold import Hold

STICK, TRAY, PLATE = Hold("stick", "grip"), Hold("tray", "rim"), Hold("plate", "knob")


@dataclasses.dataclass(frozen=True)
class Ride:
    object: str
    hold: Hold
    link: str = "top"


@dataclasses.dataclass(frozen=True)
class Placed:
    """Stands for `PlacedObject`: what is done with it is noted in its placement."""

    name: str
    free: bool = True
    placement: str = "start"

    @property
    def object(self) -> Any:
        return SimpleNamespace(free=self.free)


def moments(
    phases: list[Any], number: int, monkeypatch: Any, holds: tuple[Hold, ...] = ()
) -> list[tuple[Any, ...]]:
    objects: dict[str, Any] = {name: Placed(name) for name in ("stick", "tray", "cup")} | {
        "plate": Placed("plate", False)
    }
    scene: Any = SimpleNamespace(objects=objects, holds=holds)
    rides = {ride for phase in phases for ride in phase.supported}
    chain: Any = SimpleNamespace(
        held_geometries={hold: hold.object for hold in (STICK, TRAY, PLATE)},
        ride_geometries={ride: ride.object for ride in rides},
    )

    def ridden(scene: Any, ride: Ride, carrier: Placed) -> Placed:
        on: Placed = dataclasses.replace(objects[ride.object], placement=f"on {carrier.placement}")
        return on

    monkeypatch.setattr(module, "_place_supported_object", ridden)
    monkeypatch.setattr(
        module,
        "_with_joint_positions",
        lambda placed, state: dataclasses.replace(placed, placement=str(state)),
    )
    task: Any = SimpleNamespace(phases=phases)
    return [
        (shapes, placed.placement, begins)
        for shapes, placed, begins in _find_lift_and_place_moments(scene, chain, task, number)
    ]


def phase(held: tuple[Hold, ...] = (), rides: tuple[Ride, ...] = (), **fields: Any) -> Any:
    empty = {"lifted": {}, "lowered": {}, "initial_values": {}, "values": {}, "ranges": {}}
    return SimpleNamespace(held=held, supported=rides, **{**empty, **fields})


def test_the_margin_is_half_of_what_there_is() -> None:
    assert REDUCED_MARGIN_RATIO == 0.5


def test_what_is_in_the_hand_at_the_start_begins_there(monkeypatch: Any) -> None:
    """In the first phase, if it is held then; a door stays where it is."""
    first, second = phase((STICK, PLATE)), phase((STICK,))
    held = (STICK, PLATE)
    assert moments([first, second], 0, monkeypatch, held) == [("stick", "start", True)]
    assert moments([first, second], 1, monkeypatch, held) == []
    assert moments([first, second], 0, monkeypatch) == []
    assert moments([phase(), second], 0, monkeypatch, held) == []


def test_what_is_lifted_begins_and_what_is_lowered_ends(monkeypatch: Any) -> None:
    """With what rides on it, and that alone."""
    on_tray, on_stick = Ride("cup", TRAY), Ride("cup", STICK)
    now = phase(
        (STICK, TRAY), (on_tray,), lifted={TRAY: "here"}, lowered={STICK: "there", PLATE: "nowhere"}
    )
    assert moments([phase(), now], 1, monkeypatch) == [
        ("tray", "here", True),
        ("cup", "on here", True),
        ("stick", "there", False),
    ]
    now = phase((STICK, TRAY), (on_stick,), lifted={TRAY: "here"}, lowered={STICK: "there"})
    assert moments([phase(), now], 1, monkeypatch) == [
        ("tray", "here", True),
        ("stick", "there", False),
        ("cup", "on there", False),
    ]


def test_what_rides_on_what_stands_fixed_begins_and_ends_with_the_phase(monkeypatch: Any) -> None:
    """Where the carrier's joints were before, and where they are to be: within what they may."""
    ride = Ride("cup", PLATE)
    now = phase(
        (PLATE,),
        (ride,),
        initial_values={"plate.slide": 0.0, "door.hinge": 1.0},
        values={"plate.slide": 0.5},
        ranges={"plate.slide": (0.0, 0.25)},
    )
    assert moments([phase(), now], 1, monkeypatch) == [
        ("cup", f"on {now.initial_values}", True),
        ("cup", f"on { {**now.initial_values, 'plate.slide': 0.25} }", False),
    ]


def test_only_an_objects_own_coordinates_are_its_state() -> None:
    given: list[Any] = []
    placed: Any = SimpleNamespace(name="plate", with_state=given.append)
    module._with_joint_positions(
        placed,
        {
            "plate.slide": 0.5,
            "plates.slide": 0.1,
            "door.hinge": 1.0,
            "plate.turn": np.float64(0.25),
        },
    )
    assert given == [{"slide": 0.5, "turn": 0.25}]
