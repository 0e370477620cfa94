"""Compares the nonlinear program with its definition, and its derivatives with differences."""

from __future__ import annotations

import dataclasses
import itertools
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_table, make_room
from helpers.held_sticks import make_scene_with_held_stick
from helpers.program_points import QUIET, ProgramPoint, make_random_point
from helpers.relaxed import check_relaxation, make_iterates
from helpers.small_problems import CACHE, load_door_scene, make_program
from helpers.telescopes import write_coupled_scene

import vkc_pin as vkc
from vkc_pin.options import Options
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.nlp.transcription import transcribe
from vkc_pin.planning.nlp.waypoint import Structure
from vkc_pin.utils.cache import Cache
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Touch
from vkc_pin.world.trajectory.wheels import RollingLimits

OPTIONS = Options(reach_waypoints=3, turn_waypoints=2, move_waypoints=3, contact_slots=2)
POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))


@cache
def make_wheeled_scene(base: str) -> Scene:
    turning = {"turning_radius": 0.8} if base == "ackermann" else {}
    return dataclasses.replace(
        load_door_scene(), robot=load_robot("husky_ur5e", base=base, **turning)
    )


@cache
def make_problem(name: str) -> TrajectoryProblem:
    options = OPTIONS
    if name == "door":
        scene, steps = load_door_scene(), [Actuate("door", {"hinge": 1.2})]
    elif name == "push":  # held at the start, pushed towards smaller angles
        scene = (
            load_door_scene().with_state("door", {"hinge": 1.0}).with_held({"door": "push_back"})
        )
        steps = [Actuate("door", {"hinge": 0.5}), GoTo(0.0, 0.0)]
    elif name == "stick":  # a clamped grasp, a point goal and an upright goal
        scene = make_room(describe_table())
        steps = [Touch("stick.tip", (0.8, 0.9, 0.7)), Place("stick", (0.8, 0.5, 0.56))]
    elif name == "fetch":  # fetches a ball with the stick, then releases the stick
        scene = make_scene_with_held_stick()
        steps = [Grasp("ball", "pull", "stick.tip"), Place("ball", POSE), Release("stick")]
        steps.append(GoTo(0.0, 0.0))
    elif name == "telescope":  # one coordinate moves several joints
        with tempfile.TemporaryDirectory() as folder:
            scene = write_coupled_scene(Path(folder))
        steps = [Actuate("drawer", {scene.objects["drawer"].object.coordinates.names[0]: 0.1})]
    else:
        scene, steps = make_wheeled_scene(name), [Reach(POSE), GoTo(0.0, 0.0, 1.0)]
        options = dataclasses.replace(OPTIONS, contact_slots=1)
    return make_program(scene, steps, options=options)


NAMES = ["door", "differential", "ackermann", "stick", "fetch", "push", "telescope"]


def find_runs(p: TrajectoryProblem) -> list[np.ndarray]:
    """Return the waypoints of each run between rests: start, grasps, releases and end."""
    stops = [0, *p.transcription.structure.stops, p.segments]
    return [np.arange(a, b + 1) for a, b in itertools.pairwise(stops)]


def compute_changes(path: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Return the changes of the steps within a run, from and to rest."""
    return np.diff(np.diff(path[run], axis=0), axis=0, prepend=0.0, append=0.0)


def iterate_waypoint_rows(point: ProgramPoint) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield rows of witness planes and poses, and their values by Pinocchio."""
    p, t, model = point.problem, point.problem.transcription, point.problem.chain.model
    data = model.createData()
    for k, q in enumerate(p.chain.coordinates.q(point.z)):
        pin.forwardKinematics(model, data, q)
        stacked = flatten_placements(list(data.oMi)[1:]).ravel()
        yield t.slot_rows[k], point.planes[k] @ stacked - point.offsets[k] + point.slack[k]
        for number, (pose, at) in enumerate(zip(t.structure.poses, t.pose_rows, strict=True)):
            assert (k + 1 in at) == (k + 1 in pose.waypoints)
            if k + 1 not in at:
                continue
            target = point.relax_target(k + 1, number)
            placement = data.oMi[pose.joint] * p.pose_goals[number].local
            values = [placement.translation - target.translation]
            if pose.shift is not None:
                values[0] += data.oMi[pose.shift[0]].rotation @ np.array(pose.shift[1])
            error = target.rotation.T @ placement.rotation
            if pose.kind == "pose":
                values += [pin.unSkew((error - error.T) / 2), [np.trace(error)]]
            elif pose.kind == "upright":
                values.append(target.rotation @ placement.rotation[2])
            yield at[k + 1], np.concatenate(values)


def compute_relaxed_rows(p: TrajectoryProblem, path: np.ndarray, gears: np.ndarray) -> np.ndarray:
    """Return (value, waypoint) of the other rows, including the rate rows, before relaxation."""
    rows: list[tuple[float, int]] = []
    if not p.rolling.is_omnidirectional:
        arm, radius = p.chain.robot.wheels.track / 2, 0.8
        for k in range(1, p.segments + 1):
            turn, heading = path[k, 2] - path[k - 1, 2], (path[k, 2] + path[k - 1, 2]) / 2
            x, y = pin.utils.rotate("z", heading)[:2, :2].T @ (path[k, :2] - path[k - 1, :2])
            steered = [gears[k - 1] * x - radius * turn, gears[k - 1] * x + radius * turn]
            steered = steered if p.chain.robot.base == "ackermann" else []
            rows += [(v, k) for v in (y, *steered, x - arm * turn, x + arm * turn)]
    for c, first, last in p.transcription.structure.clamped:
        rows += [(path[k, c] - path[k - 1, c], k) for k in range(first + 1, last + 1)]
    for phase, end in zip(p.task.phases, p.ends.tolist(), strict=True):
        for name, sign in phase.pushed.items():
            c, steps = p.chain.index(name), range(end - phase.segments + 1, end + 1)
            rows += [(sign * (path[k, c] - path[k - 1, c]), k) for k in steps]
    for k in range(1, p.segments + 1):
        rows += [(v, k) for v in path[k] - path[k - 1]]
    for run in find_runs(p):
        for k, change in zip(run, compute_changes(path, run), strict=True):
            rows += [(v, max(int(k), 1)) for v in change]  # a change belongs to its waypoint
    return np.array(rows)


@pytest.mark.parametrize("name", NAMES)
def test_rows_equal_their_definitions(name: str) -> None:
    """A relaxation variable removes that fraction of the excess of its waypoint's rows."""
    p = make_problem(name)
    point, t = make_random_point(p), p.transcription
    found, expected = point.rows(), np.full(t.rows + t.rate_matrix.size1(), np.nan)
    for rows, values in iterate_waypoint_rows(point):
        expected[rows] = values
    values, waypoints = compute_relaxed_rows(p, point.path, point.gears).T
    excess = np.concatenate([point.excess, point.rate_excess])
    expected[t.first_relaxed_row :] = values - point.relaxation[waypoints.astype(int) - 1] * excess
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    owners = np.concatenate([t.row_waypoints, t.rate_waypoints])
    np.testing.assert_array_equal(owners, waypoints - 1)
    steps, bends = p.rates(point.z, point.dt)
    rates = values[t.rows - t.first_relaxed_row :]
    np.testing.assert_allclose(np.r_[steps.ravel(), bends.ravel()], rates, atol=1e-12)
    squares = [np.sum(w * part**2) for w, part in zip(point.weights, (steps, bends), strict=True)]
    assert point.cost() == pytest.approx(point.penalties + sum(squares), rel=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_equal_differences(name: str) -> None:
    make_random_point(make_problem(name), seed=1).check_derivatives()


# --- relaxation
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_fully_relaxed_program_is_feasible_at_its_iterate(name: str) -> None:
    amounts = [
        check_relaxation(make_problem(name), z) for z in make_iterates(make_problem(name), 1)
    ]
    violated = {kind for kind in amounts[0] if max(each[kind] for each in amounts) > 0.1}
    expected = {"poses", "rates"} if name == "telescope" else {"poses", "clearance", "rates"}
    expected |= {"rolling"} if name in ("differential", "ackermann") else set()
    expected |= {"clamped"} if name in ("stick", "fetch", "push") else set()
    assert violated == expected, "the iterates violate other kinds of rows"


# --- reuse
# ------------------------------------------------------------------------------------------------


def test_one_program_serves_all_problems_of_a_structure() -> None:
    scene, door = load_door_scene(), load_door_scene().objects["door"]
    shift = pin.SE3(pin.utils.rotate("z", 0.4), np.array([0.3, -0.2, 0.0]))
    moved = dataclasses.replace(door, placement=shift * door.placement)
    safer = dataclasses.replace(OPTIONS, dist_safe=0.05, penalty=3.0)
    first, build_time = make_problem("door"), CACHE.build_time
    for other, hinge, options in (
        (scene.sample_start(np.random.default_rng(0)), 1.2, OPTIONS),
        (dataclasses.replace(scene, objects={"door": moved}), 1.2, OPTIONS),
        (dataclasses.replace(scene, obstacles=(), obstacle_labels=()), 1.2, OPTIONS),
        (scene, 0.4, OPTIONS),
        (scene.with_state("door", {"knob": 0.1}), 1.2, safer),
    ):
        problem = make_program(other, [Actuate("door", {"hinge": hinge})], options=options)
        assert problem.transcription is first.transcription
    assert CACHE.build_time == build_time


def test_one_program_serves_all_objects_with_the_same_joints() -> None:
    """Dimensions of an object, the grasp's place on it, and values of locked joints are data."""
    first, build_time = make_problem("door"), CACHE.build_time
    scene = load_door_scene()
    for name in ("wide_door", "narrow_door"):
        door = dataclasses.replace(scene.objects["door"], object=vkc.load_object(name))
        other = dataclasses.replace(scene, objects={"door": door})
        problem = make_program(other, [Actuate("door", {"hinge": 1.2})], options=OPTIONS)
        assert problem.transcription is first.transcription
        model, data = problem.chain.model, problem.chain.model.createData()
        z = problem.chain.lower.clip(-1.0) * 0.3
        pin.forwardKinematics(model, data, problem.chain.coordinates.q(z))
        rotations, translations = problem.chain.joint_placements(z[None])
        for joint in range(model.njoints):
            np.testing.assert_allclose(rotations[0, joint], data.oMi[joint].rotation, atol=1e-12)
            position = data.oMi[joint].translation
            np.testing.assert_allclose(translations[0, joint], position, atol=1e-12)
    assert CACHE.build_time == build_time


@pytest.mark.parametrize(
    "change",
    [
        {"segments": 6},
        {"slots": 3},
        {"poses": ()},
        {"stops": (2,)},
        {"rolling": RollingLimits()},
        {"rolling": RollingLimits(turning_radius=0.8)},
        {"rolling": RollingLimits(track=0.5, wheel_speed=1.0)},
        {"clamped": ((3, 1, 4),)},
        {"pushed": ((3, 1, 4, 1),)},
        {"pushed": ((3, 1, 4, -1),)},
        {"kind": "point"},
        {"waypoints": (1, 2)},
    ],
)
def test_different_structures_have_different_keys(change: dict[str, Any]) -> None:
    structure = make_problem("door").transcription.structure
    pose = structure.poses[0]
    one = Structure(tree=structure.tree, segments=5, poses=(pose,), slots=2)
    if set(change) & {"kind", "waypoints"}:
        change = {"poses": (dataclasses.replace(pose, **change),)}
    assert dataclasses.replace(one, **change).key != one.key


def test_solvers_are_cached() -> None:
    structure, cache = make_problem("differential").transcription.structure, Cache()
    t = transcribe(structure, cache)
    assert transcribe(structure, cache) is t
    first, build_time = t.solver(rates=False, options=QUIET), cache.build_time
    assert t.solver(rates=False, options=dict(reversed(QUIET.items()))) is first
    assert cache.build_time == build_time
    assert t.solver(rates=False, options={**QUIET, "ipopt.tol": 1e-3}) is not first
