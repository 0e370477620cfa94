"""Executes plans in physics in a world that differs from the plan, open and closed loop."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pinocchio as pin

from vkc_pin.execution.loop import execute
from vkc_pin.execution.robots import LocalisedRobot, Robot
from vkc_pin.experiments.closed_loop_verdict import Knowledge, Person, judge_execution
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, trial, values
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import count, format_table, join_sections, select
from vkc_pin.experiments.tasks import TASKS as ALL
from vkc_pin.experiments.tasks import make_start
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.simulation.physics import import_mujoco
from vkc_pin.simulation.robot import SimulatedRobot
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.estimated_joints import find_axis
from vkc_pin.world.scene.joint_estimation import JointEstimate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Place, Step
from vkc_pin.world.trajectory.frames import invert_frame, place_base

TASKS = (
    "door",
    "corridor_door",
    "drawer",
    "household_refrigerator",
    "household_cabinet",
    "household_cup",
)
"""Tasks that are executed."""

ROWS: Mapping[str, str] = {
    "nothing": "the world is as planned",
    "displaced": "the object is up to 50 mm and 5° elsewhere, which is noticed at 1 m",
    "obstacle": "an obstacle appears on the path, 1.5 m ahead of the base, with a motion round it",
    "person": "a person crosses the path of the base at 0.5 to 1 m/s, and is given 0.6 m of room",
    "localisation": "the base is localised 20 mm and 1° off, and drifts by 5 mm/m and 0.2°/m, "
    "unless the hand is within 1 m of its grasp, or of where its motion ends; plans keep 30 mm of "
    "clearance, and contacts before it is localised do not count",
    "grasp": "the hand closes up to 8 mm and 3° off, which is noticed then",
    "axis": "the hinge's axis or slide's direction is up to 30 mm and 5° elsewhere, the handle is "
    "not; a camera sees the grasped link with 1 mm and 0.3° of noise",
}
"""Name of a row of the table → what differs from the plan."""

_JOINTLESS = ("household_cup",)
"""Tasks without a joint, to which the row "axis" does not apply."""
_PERSON = "person"
_WIDTH = 0.2  # [m], radius of a person and of what appears
# [m], radius of the room that a person may need before the robot has come to rest: 0.6 s at 1 m/s
_ROOM = 0.8
_HEIGHT = 1.6  # [m]
_AWAY = -5.0  # [m], height of an obstacle below the floor, where it touches nothing
_NOTICE = 1.0  # [m] from the hand to its grasp at which an object is seen
_BRAKING = 1.5  # [m] from the base's origin at which something may appear
_DRAWS = 20  # of places
_BEGIN = 0.05  # [s], when motions of the open loop begin
_REST = 1.0  # [s] after the end of a motion, before it is judged
_SAME = 1e-6  # [m], [rad] between equal placements
_FEW = {**LIMITS, "max_evaluations": 200_000}  # limits of a motion round it
_AXIS_SHIFT = 0.03  # [m]
_AXIS_TURN = np.radians(5.0)
_LINK_NOISE = (0.001, float(np.radians(0.3)))  # of a camera: position [m] and rotation [rad]
# Limits of a pull: a third of the load that breaks a grasp, three times that of an undisturbed one
_FORCE_LIMIT = 93.0  # [N]
_TORQUE_LIMIT = 10.0  # [N·m]
_TRACKING = 0.008  # [m], [rad]; six times the servos' largest error in undisturbed motions
_UNCERTAIN_CLEARANCE = 0.03  # [m], that starts have
_UPDATE = 0.05  # [m] of travel between two corrections of the localisation


Observation = Callable[[Scene, SimulatedRobot], Scene]


@dataclass(frozen=True)
class Disturbance:
    """What differs from the plan.

    Attributes:
        actual: The scene as it really is, at the start.
        observe: Updates a scene as the robot sees the world: (scene, robot) → scene.
        displaced: Object that is elsewhere; "" if none is.
        obstacle: Time [s] → centre of the moving obstacle, shape (3,); None without one.
        offset, drift: See `SimulatedRobot`.
        landmarks: Places, shape (3,) each, near which the robot sees where it is.
    """

    actual: Scene
    observe: Observation
    displaced: str = ""
    obstacle: Callable[[float], Floats] | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    landmarks: tuple[Floats, ...] = ()


def run(
    *,
    out: str | Path,
    trials: int = 20,
    seed: int = 0,
    tasks: Sequence[str] | None = None,
    rows: Sequence[str] | None = None,
    save_motions: bool = False,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        trials: Number of random starts per task and row, at least 1.
        seed: Random seed of starts, planning and differences.
        tasks: Some of `TASKS`. Default: all.
        rows: Some of `ROWS`. Default: all.
        save_motions: Whether to save how the robots really moved in the closed loop, as plans
            `out`/motions/ROW_TASK_NUMBER.npz in the world as it really was.
    """
    import_mujoco()
    runner.check_positive(trials=trials)
    names = runner.select_names("task", TASKS if tasks is None else tasks, TASKS)
    kinds = runner.select_names("row", tuple(ROWS) if rows is None else rows, tuple(ROWS))
    settings = {
        "benchmark": "closed-loop",
        "seed": seed,
        "starts": trials,
        "tasks": names,
        "rows": kinds,
        "mujoco": version("mujoco"),
        **LIMITS,
    }
    specs = []
    for row, name, number in itertools.product(kinds, names, range(trials)):
        if not _applies(row, name):
            continue
        key = f"{list(ROWS).index(row)}/{TASKS.index(name)}/{number:04d}"
        specs.append({"key": key, "row": row, "task": name, "number": number, "seed": seed})
    record = functools.partial(_record, motions=Path(out) / "motions" if save_motions else None)
    return runner.run(
        specs, record, out, settings=settings, format_results=format_results, **execution
    )


def _applies(row: str, task: str) -> bool:
    """Return whether a row of the table has trials of a task."""
    return row != "axis" or task not in _JOINTLESS


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    figures = ["plans", "open", "closed", "deepest [mm]", "latency [ms]", "cycles [%]"]
    head = ["row", "task", *figures]
    summary = []
    rows = []
    for row, name in itertools.product(about["rows"], about["tasks"]):
        cells = ["does not apply: no joint", *("–" for _ in figures[1:])]
        if _applies(row, name):
            cells = _summarize(select(records, row=row, task=name))
        rows.append([row, name, *cells])
    for row in about["rows"]:
        summary.append([row, *_summarize(select(records, row=row))])
    lines = ["## Trials that failed in the closed loop", ""]
    for record in records:
        if record["success"] and not record.get("closed"):
            where = f"{record['row']}, {record['task']}, start {record['number']}"
            lines.append(f"- {where}, seed {record['seed']}: {record['closed_reason']}")
    return join_sections(
        about,
        "# Plans in a world that differs",
        f"{about['starts']} random starts per row and task, seed {about['seed']}, "
        f"{describe_limit(about)} each. Robots in physics are judged by their real motions: "
        "goals within 10 mm and 0.02 rad, grasps that last, and no collision that the robot could "
        "know of, that the motion does not have in the world of its plan, and that is deeper "
        "than 1 mm or pushes a free object further. Time passes for the robot while the program "
        "computes. Latencies are the median and the 95th percentile of cycles that "
        "planned again; cycles are those that kept 20 Hz.",
        "\n".join(f"- {row}: {ROWS[row]}" for row in about["rows"]),
        format_table(["what differs", *figures], summary),
        format_table(head, rows),
        "\n".join(lines),
    )


def _summarize(records: Sequence[Record]) -> list[str]:
    planned = select(records, success=True)
    latencies = [1e3 * value for record in planned for value in record["latencies"]]
    deepest = values(planned, "closed_depth")
    cycles = sum(record["cycles"] for record in planned)
    late = sum(record["late"] for record in planned)
    middle = "–"
    if latencies:
        middle = f"{np.median(latencies):.0f}, {np.quantile(latencies, 0.95):.0f}"
    return [
        count(records),
        count(planned, "open"),
        count(planned, "closed"),
        f"{1e3 * max(deepest):.1f}" if deepest else "–",
        middle,
        f"{100.0 * (1.0 - late / cycles):.1f}" if cycles else "–",
    ]


def _record(spec: dict[str, Any], *, motions: Path | None) -> dict[str, Any]:
    """Plan and execute a trial, open and closed loop, and return its record.

    Args:
        spec: The trial.
        motions: Folder for the motion of the closed loop. None: it is not saved.
    """
    seed, row = spec["seed"], spec["row"]
    rng = np.random.default_rng([seed, list(ROWS).index(row), spec["number"]])
    radius = _ROOM if row == "person" else _WIDTH
    start = _add_person(make_start(spec["task"], seed, spec["number"]), radius)
    is_mislocalised = row == "localisation"
    limits = Options(dist_safe=_UNCERTAIN_CLEARANCE) if is_mislocalised else Options()
    found = plan(start, ALL[spec["task"]].steps, options=limits, seed=seed, **LIMITS)
    fields: dict[str, Any] = {"row": row, "task": spec["task"], "number": spec["number"]}
    if not found.success:
        return trial(found, method="VKC", seed=seed, **fields)
    disturbance = _disturb(row, found, rng)
    person = None
    if disturbance.obstacle is not None:
        person = Person(_PERSON, _WIDTH, _HEIGHT, disturbance.obstacle)

    robot = _make_robot(found, disturbance, spec)
    robot.send(found.trajectory, _BEGIN)
    robot.wait(_BEGIN + float(found.trajectory.times[-1]) + _REST)
    nothing_known = Knowledge(disturbance.displaced, math.inf, math.inf if is_mislocalised else 0.0)
    sent = [(_BEGIN, found)]
    fields |= _describe("open", robot, *judge_execution(found, robot, sent, nothing_known, person))

    robot = _make_robot(found, disturbance, spec)
    seen_since = math.inf

    def observe(scene: Scene) -> Scene:
        nonlocal seen_since
        seen = disturbance.observe(scene, robot)
        if disturbance.displaced and _is_elsewhere(seen, found.scene, disturbance.displaced):
            seen_since = min(seen_since, robot.time)
        return seen

    options: dict[str, Any] = {}
    if row == "axis":
        options = {
            "observe_link": _make_camera(robot, np.random.default_rng([seed, spec["number"]])),
            "link_noise": _LINK_NOISE,
            "force_limit": _FORCE_LIMIT,
            "torque_limit": _TORQUE_LIMIT,
        }
    driver: Robot = robot
    if is_mislocalised:
        localise = _Localisation(robot, found.scene, disturbance.landmarks)
        driver = LocalisedRobot(robot, localise, step=_TRACKING)
        options = {"tracking": _TRACKING}
    result = execute(found, driver, observe=observe, **options)
    robot.wait(robot.time + _REST)
    localised_since = localise.since if is_mislocalised else 0.0
    known = Knowledge(disturbance.displaced, seen_since, localised_since)
    reasons, depth = judge_execution(found, robot, result.plans, known, person)
    if not result.success:
        reasons.insert(0, result.reason)
    fields |= _describe("closed", robot, reasons, depth)
    if motions is not None:
        motions.mkdir(parents=True, exist_ok=True)
        path = motions / f"{row}_{spec['task']}_{spec['number']:04d}.npz"
        _make_executed_plan(found, robot, disturbance.actual).save(path)
        fields["motion"] = f"{motions.name}/{path.name}"
    fields |= {
        "recorded_since": float(robot.trajectory().times[0]),
        "object": known.object,
        "object_since": seen_since if math.isfinite(seen_since) else None,
        "robot_since": localised_since if math.isfinite(localised_since) else None,
        "decisions": result.count_decisions(),
        "latencies": result.latencies.get("replan", []),
        "cycles": len(result.cycles),
        "late": result.late,
    }
    return trial(found, method="VKC", seed=seed, duration=found.metrics["duration"], **fields)


def _make_executed_plan(found: Plan, robot: SimulatedRobot, actual: Scene) -> Plan:
    """Return the real motion of a robot in the real world as a plan, which it hardly satisfies."""
    motion = robot.trajectory()
    phases = []
    for phase in motion.phases:  # measured grasps are those of the scenes of later motions
        phases.append(replace(phase, holds=tuple(hold.nominal for hold in phase.holds)))
    motion = replace(motion, times=motion.times - motion.times[0], phases=tuple(phases))
    start = motion.positions[0, : motion.robot_size]
    scene = actual.with_start(base=start[:3], arm=start[3:], velocity={})
    report = validate(scene, found.steps, motion, found.options)
    status = "success" if report.ok else "rejected"
    return Plan(scene, found.steps, found.options, motion, report, status)


def _is_elsewhere(seen: Scene, planned: Scene, name: str) -> bool:
    """Return whether an object is not where a scene has it."""
    return not seen.objects[name].placement.isApprox(planned.objects[name].placement, _SAME)


def _describe(
    loop: str, robot: SimulatedRobot, reasons: Sequence[str], depth: float
) -> dict[str, Any]:
    """Return the fields of a record about an execution."""
    return {
        loop: not reasons,
        f"{loop}_reason": "; ".join(reasons),
        f"{loop}_depth": depth,
        f"{loop}_force": max((grip.force for grip in robot.grips), default=0.0),
        f"{loop}_torque": max((grip.torque for grip in robot.grips), default=0.0),
    }


def _make_robot(found: Plan, disturbance: Disturbance, spec: Mapping[str, Any]) -> SimulatedRobot:
    return SimulatedRobot(
        found.scene,
        actual=disturbance.actual,
        seed=spec["seed"],
        base_offset=disturbance.offset,
        base_drift=disturbance.drift,
    )


def _add_person(scene: Scene, radius: float) -> Scene:
    """Return a scene with a cylinder of a radius [m] below the floor."""
    person = {
        "name": _PERSON,
        "type": "cylinder",
        "radius": radius,
        "length": _HEIGHT,
        "position": [0.0, 0.0, _AWAY],
    }
    document = dict(scene.document)
    document["obstacles"] = [*document.get("obstacles", []), person]
    return Scene.from_document(document, scene.folder)


def _disturb(row: str, found: Plan, rng: np.random.Generator) -> Disturbance:
    """Return what differs from a plan in a row of the table."""
    scene = found.scene
    step = found.steps[0]
    assert isinstance(step, Actuate | Place)
    name = step.object
    closing = float(found.trajectory.times[found.trajectory.phases[0].last])
    at_grasp = found.pose(None, closing).translation

    def see_from_near(known: Scene, robot: SimulatedRobot) -> Scene:
        is_near = _is_near(scene, robot.read().positions, at_grasp)
        return _see_object(known, name, robot) if is_near else known

    def see_in_hand(known: Scene, robot: SimulatedRobot) -> Scene:
        is_closed = robot.time > closing + found.options.grasp_time
        return _see_object(known, name, robot) if is_closed else known

    if row == "displaced":
        at = scene.objects[name].placement.translation
        actual = displace_object(scene, name, 0.05, np.radians(5.0), at, rng)
        return Disturbance(actual, see_from_near, name)
    if row == "grasp":
        actual = displace_object(scene, name, 0.008, np.radians(3.0), at_grasp, rng)
        return Disturbance(actual, see_in_hand, name)
    if row == "localisation":
        angle = rng.uniform(0.0, 2.0 * np.pi)
        signs = rng.choice([-1.0, 1.0], 2)
        offset = (0.02 * np.cos(angle), 0.02 * np.sin(angle), np.radians(1.0) * signs[0])
        drift = (0.005 * np.cos(angle), 0.005 * np.sin(angle), np.radians(0.2) * signs[1])
        at_end = found.pose(None, float(found.trajectory.times[-1])).translation
        landmarks = (at_grasp, at_end)
        return Disturbance(scene, see_from_near, offset=offset, drift=drift, landmarks=landmarks)
    if row == "axis":
        return Disturbance(_choose_axis(scene, step, rng), lambda known, *_: known)
    if row == "nothing":
        return Disturbance(scene, lambda known, *_: known)
    return _obstruct(row, found, closing, rng)


def _see_object(known: Scene, name: str, robot: SimulatedRobot) -> Scene:
    """Return a scene in which an object is where it really is, unless the hand carries it.

    A free object counts as standing upright, at the height where it stood, even if it is touched.
    """
    seen = robot.object_states()[name].placement
    placed = known.objects[name]
    if placed.object.free:
        if name in robot.held:
            return known
        before = placed.placement
        turn = seen.rotation @ before.rotation.T
        upright = pin.utils.rotate("z", math.atan2(turn[1, 0], turn[0, 0]))
        position = np.array([*seen.translation[:2], before.translation[2]])
        seen = pin.SE3(upright @ before.rotation, position)
    return known.with_placement(name, seen)


def _is_near(scene: Scene, measured: Floats, place: Floats) -> bool:
    """Return whether the hand is near enough to a place to see it."""
    there = scene.with_start(base=measured[:3], arm=measured[3:], velocity={})
    return float(np.linalg.norm(there.tool_placement().translation - place)) < _NOTICE


def displace_object(
    scene: Scene, name: str, largest: float, turn: float, about: Floats, rng: np.random.Generator
) -> Scene:
    """Return a scene with an object elsewhere, by up to a distance [m] and an angle [rad].

    It is turned about the vertical through a place, shape (3,).
    """
    at = scene.objects[name].placement
    angle, direction = rng.uniform(-turn, turn), rng.uniform(0.0, 2.0 * np.pi)
    shift = largest * rng.uniform() * np.array([np.cos(direction), np.sin(direction), 0.0])
    rotation = pin.utils.rotate("z", angle)
    position = about + rotation @ (at.translation - about) + shift
    return scene.with_placement(name, pin.SE3(rotation @ at.rotation, position))


def _choose_axis(scene: Scene, step: Step, rng: np.random.Generator) -> Scene:
    """Return a scene in which a joint has another axis, and the step can be carried out.

    About most axes that are not vertical, a door cannot open far: its leaf meets the wall.
    """
    for _ in range(_DRAWS):
        actual = _displace_axis(scene, step, rng)
        if plan(actual, [step], **_FEW).success:
            return actual
    return scene


def _displace_axis(scene: Scene, step: Step, rng: np.random.Generator) -> Scene:
    """Return a scene in which the joint that a step moves has another axis.

    The axis is turned and displaced at the height of the handle. The grasped link is where it was.
    """
    assert isinstance(step, Actuate)
    placed = scene.objects[step.object]
    (joint,) = step.joints
    attachment = placed.object.attachment(step.attachment)
    link = placed.link_placement(attachment.link)
    handle = (link * attachment.placement).translation
    kind, axis, point = find_axis(placed, joint)
    foot = point + axis * (axis @ (handle - point))
    across = np.linalg.svd(axis[None])[2][1:]
    turn = rng.uniform(0.0, _AXIS_TURN) * _draw_direction(rng) @ across
    shift = rng.uniform(0.0, _AXIS_SHIFT) * _draw_direction(rng) @ across
    actual = JointEstimate(
        kind=kind,
        axis=pin.exp3(turn) @ axis,
        point=foot + shift,
        link=link,
        positions=np.zeros(1),
        axis_deviation=0.0,
        point_deviation=0.0,
        information={},
    )
    return scene.with_measured_joint(step.object, joint, actual, link=attachment.link)


def _draw_direction(rng: np.random.Generator) -> Floats:
    """Return a random unit vector in the plane, shape (2,)."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _make_camera(
    robot: SimulatedRobot, rng: np.random.Generator
) -> Callable[[str, str], pin.SE3 | None]:
    """Return a function that measures where a link of an object is: (object, link) → pose."""

    def see(name: str, link: str) -> pin.SE3:
        pose = robot.locate(name, link)
        turn = pin.exp3(rng.normal(0.0, _LINK_NOISE[1], 3))
        position = pose.translation + rng.normal(0.0, _LINK_NOISE[0], 3)
        return pin.SE3(pose.rotation @ turn, position)

    return see


class _Localisation:
    """Localises a robot near landmarks, whenever it has moved on a little.

    The robot believes to be at q + b when it is at q. The odometry's frame is corrected by the bias
    b at this time, and stays as it is until the next correction.

    Attributes:
        since: Time of the first correction [s]; inf before.
    """

    def __init__(self, robot: SimulatedRobot, scene: Scene, landmarks: Sequence[Floats]) -> None:
        self._robot = robot
        self._scene = scene
        self._landmarks = landmarks
        self._frame = np.zeros(3)
        self._place = robot.read().positions[:2]  # of the last correction
        self.since = math.inf

    def __call__(self) -> Floats:
        """Return the odometry's frame in the scene now: x, y [m], yaw [rad]."""
        measured = self._robot.read().positions
        base = measured[:3]
        seen = place_base(self._frame, measured)
        is_near = any(_is_near(self._scene, seen, mark) for mark in self._landmarks)
        if is_near and np.linalg.norm(base[:2] - self._place) > _UPDATE:
            self._place = base[:2].copy()
            self._frame = place_base(base - self._robot.bias, invert_frame(base))
            self.since = min(self.since, self._robot.time)
        return self._frame


def _obstruct(row: str, found: Plan, closing: float, rng: np.random.Generator) -> Disturbance:
    """Return something that appears on the base's path, or somebody who crosses it."""
    motion = found.trajectory
    moment = closing * rng.uniform(0.4, 0.7)  # when the base would be there
    place = motion.at(moment)[:2]
    velocity = motion.velocity(moment)[:2]
    along = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
    across = np.array([-along[1], along[0]])
    if row == "obstacle":
        return _appear(found, closing, rng)
    speed = rng.uniform(0.5, 1.0) * rng.choice([-1.0, 1.0])
    crosses = moment + rng.uniform(-0.5, 0.5)

    def walk(clock: float) -> Floats:
        return np.array([*(place + across * speed * (clock - crosses)), _HEIGHT / 2])

    return Disturbance(found.scene, _see_obstacle(walk), obstacle=walk)


def _appear(found: Plan, closing: float, rng: np.random.Generator) -> Disturbance:
    """Return something that appears ahead of the base, so that there still is a motion.

    The robot could brake before it, and a motion is found if it stands there from the start.
    """
    motion = found.trajectory
    times = np.linspace(0.0, closing, 200)
    path = motion.at(times)[:, :2]
    for _ in range(_DRAWS):
        moment = int(rng.integers(len(times) // 3, len(times)))
        place = path[moment] + rng.uniform(-0.5, 0.5, 2)
        is_far = np.linalg.norm(path - place, axis=1) > _BRAKING
        if not is_far[0]:
            continue
        last = int(np.argmin(is_far)) - 1 if not is_far.all() else len(times) - 1
        appears = float(times[last])
        there = found.scene.with_obstacle(_PERSON, [*place, _HEIGHT / 2, 0.0, 0.0, 0.0])
        if validate(there, found.steps, motion, found.options).ok:
            continue  # the motion does not touch it
        if plan(there, found.steps, **_FEW).success:
            break
    else:
        appears = math.inf

    def stand(clock: float) -> Floats:
        return np.array([*place, _HEIGHT / 2 if clock >= appears else _AWAY])

    return Disturbance(found.scene, _see_obstacle(stand), obstacle=stand)


def _see_obstacle(obstacle: Callable[[float], Floats]) -> Observation:
    def see(known: Scene, robot: SimulatedRobot) -> Scene:
        return known.with_obstacle(_PERSON, [*obstacle(robot.time), 0.0, 0.0, 0.0])

    return see
