"""Tests that an execution which starts where another ended changes nothing by itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import drive_through, move_start
from helpers.executions import make_grasping_scene, make_stationary_motion, replace_mass
from helpers.held_sticks import make_scene_with_held_stick

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate
from vkc_pin.world.scene.scene import Scene

RESTARTS = 5


def stand_still(scene: Scene, grasp: str = "weld") -> Scene:
    """Return the scene after an execution that keeps everything where it is, for 0.2 s."""
    x, y, yaw = scene.start[:3].tolist()
    step = vkc.Actuate("drawer", {"slide": 0.2}) if "drawer" in scene.held else vkc.GoTo(x, y, yaw)
    return simulate(scene, [step], make_stationary_motion(scene, 0.2), grasp=grasp).end_scene()


def make_slender(scene: Scene, radius: float) -> Scene:
    """Return the scene with hardly any inertia about the stick's axis, as a thin rod has."""
    placed = scene.objects["stick"]
    model = pin.Model(placed.object.model)
    last = len(model.inertias) - 1
    inertia = model.inertias[last]
    moments, axes = np.linalg.eigh(np.asarray(inertia.inertia))
    moments[0] = inertia.mass * radius**2 / 2.0
    tensor = axes @ np.diag(moments) @ axes.T
    model.inertias[last] = pin.Inertia(inertia.mass, inertia.lever, tensor)
    changed = dataclasses.replace(placed, object=dataclasses.replace(placed.object, model=model))
    return dataclasses.replace(scene, objects={**scene.objects, "stick": changed})


def make_scene_with_cup() -> Scene:
    """Return the household with the cup in the hand, and still on the table."""
    plan = vkc.plan(vkc.load_scene("household"), [vkc.Grasp("cup")])
    return plan.simulate().end_scene()


def make_scene_with_drawer() -> Scene:
    """Return the drawer's scene with the hand at the open drawer."""
    steps = [vkc.Actuate("drawer", {"slide": 0.2})]
    return vkc.plan(vkc.load_scene("drawer"), steps).simulate().end_scene()


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(make_scene_with_held_stick, id="horizontal stick"),
        pytest.param(lambda: replace_mass(make_scene_with_held_stick(), "stick", 3.0), id="3 kg"),
        pytest.param(lambda: replace_mass(make_grasping_scene(), "stick", 8.0), id="8 kg"),
        pytest.param(lambda: make_slender(make_scene_with_held_stick(), 2e-3), id="rod of 4 mm"),
        pytest.param(
            lambda: vkc.load_scene("household").with_held({"cup": "side"}),
            id="cup",
            marks=pytest.mark.long,
        ),
        pytest.param(make_scene_with_cup, id="cup on the table", marks=pytest.mark.long),
        pytest.param(make_scene_with_drawer, id="drawer"),
    ],
)
def test_restarts_change_neither_grasp_nor_robot(make: Callable[[], Scene]) -> None:
    """Servos and welds give way under load only once, and neither drop nor creep at a restart."""
    first = scene = make()
    for _ in range(RESTARTS):
        scene = stand_still(scene)
    name = first.holds[0].object
    moved = measure_turn(first, scene, name)
    assert np.abs(moved).max() < 2e-5, moved
    assert np.abs(scene.start - first.start).max() < 2e-4
    assert [hold.nominal for hold in scene.holds] == [hold.nominal for hold in first.holds]


def measure_turn(first: Scene, last: Scene, name: str = "stick") -> np.ndarray:
    """Return by how much an object moved in the hand, shape (6,) [m] and [rad]."""
    before, after = (
        one.tool_placement().actInv(one.objects[name].placement) for one in (first, last)
    )
    return pin.log6(before.actInv(after)).vector


def test_grasp_stays_where_the_robot_slightly_exceeds_the_arena() -> None:
    """The base drives off the arena's border and back; each time it stops a few µm beyond it."""
    first = make_scene_with_held_stick()
    first = scene = first.with_start(base=[first.arena[1], 0.0, 0.0])
    for _ in range(RESTARTS):
        x = float(scene.start[0])
        motion = drive_through(
            scene, scene.start, move_start(scene.start, x=x - 0.2), scene.start, dt=0.025
        )
        held = tuple(dataclasses.replace(phase, holds=scene.holds) for phase in motion.phases)
        rest = make_stationary_motion(scene)
        positions = np.column_stack(
            [
                motion.positions,
                np.tile(rest.positions[0, rest.robot_size :], (len(motion.times), 1)),
            ]
        )
        motion = dataclasses.replace(motion, names=rest.names, positions=positions, phases=held)
        result = simulate(scene, [vkc.GoTo(x, 0.0, 0.0)], motion)
        assert result.rows[-1, 0] > first.arena[1]
        scene = result.end_scene()
        assert scene.start[0] <= first.arena[1]
    moved = measure_turn(first, scene)
    assert np.abs(moved).max() < 1e-6, moved


@pytest.mark.parametrize("mass", [0.4, 4.0, 15.0])
def test_weld_is_stable_at_any_time_step(mass: float) -> None:
    """Grasps shorten time steps with which a light wrist would oscillate under its load."""
    first = scene = replace_mass(make_scene_with_held_stick(), "stick", mass)
    x, y, yaw = scene.start[:3].tolist()
    physics = vkc.Physics(timestep=0.01)
    for _ in range(2):
        motion = make_stationary_motion(scene, 0.4)
        result = simulate(scene, [vkc.GoTo(x, y, yaw)], motion, physics=physics)
        assert result.tracking.arm[0] < 1e-4
        scene = result.end_scene()
    moved = measure_turn(first, scene)
    assert np.abs(moved).max() < 2e-5, moved


def test_grasp_carried_from_plan_to_plan_stays() -> None:
    """A stick is moved to and fro, each time from where the execution before ended."""
    scene = vkc.load_scene("init_1")
    touch = vkc.Touch("stick.tip", (-1.0, 3.897, 0.1))
    angles = []
    for step in (vkc.Grasp("stick"), touch, vkc.GoTo(1.0, -1.0), touch, vkc.GoTo(1.0, -1.0)):
        result = vkc.plan(scene, [step]).simulate()
        assert result.ok, result.summary()
        scene = result.end_scene()
        angles.append(float(np.linalg.norm(scene.holds[0].deviation[3:])))
    assert np.ptp(angles) < 1e-4


def test_held_object_hardly_gives_way() -> None:
    """A weld is as stiff for a thin rod as for a thick stick."""
    scene = make_slender(make_scene_with_held_stick(), 2e-3)
    before = scene.objects["stick"].placement
    bare = scene.with_held({}).with_placement("stick", before)
    motion = make_stationary_motion(scene, 1.0)
    held = dataclasses.replace(motion, phases=(dataclasses.replace(motion.phases[0]),))
    result = simulate(scene, [vkc.Grasp("stick")], held, actual=bare)
    assert result.misses[1].amount < 1e-3


def test_fingers_hold_an_object_without_creep() -> None:
    """Friction carries a horizontal stick, whose weight turns it about the pads."""
    first = scene = make_scene_with_held_stick()
    for _ in range(3):
        scene = stand_still(scene, "friction")
    turned = np.array(scene.holds[0].deviation[3:])
    assert np.linalg.norm(turned) < 1e-3
    assert np.abs(scene.start - first.start).max() < 1e-3
