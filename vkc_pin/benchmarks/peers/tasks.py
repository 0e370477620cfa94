"""What all planners are given: reaches in random rooms, and a door and a drawer that are held at the start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vkc_pin.benchmarks.problems.poses import pose_among, pose_over, random_start
from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import compute_shortfall, sample_goal_configurations
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.procedural.rooms.random_room import sample_layout
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, Grasp, Reach, Step

__all__ = ["TASKS", "Given", "beginning", "ends", "given", "problem_of"]

TASKS: Mapping[str, str] = {
    "reach": "bring the tool to a pose, base and arm, in a random room",
    "door": "push a door by 1.2 rad whose lever is held",
    "drawer": "pull a drawer out by 0.3 m whose handle is held",
}
"""What is done: name → in words."""
_HELD: Mapping[str, tuple[str, float, Mapping[str, float]]] = {
    "door": ("hinge", 1.2, {"knob": 0.55}),
    "drawer": ("slide", 0.3, {}),
}
_EXACT = 1e-7  # [m] and [rad] of goals, as planners on manifolds ask for
_DRAWS = 20  # times that grasps are drawn
_ROOMS = 70_000  # numbers of rooms that nothing else is measured in begin here


@dataclass(frozen=True, eq=False)
class Given:
    """One problem.

    Attributes:
        scene: Where it begins; in the scene of a held thing the robot holds it.
        steps: What should change.
    """

    scene: Scene
    steps: tuple[Step, ...]


def given(task: str, seed: int, number: int) -> Given:
    """Return a problem, which follows from numbers alone: no planner was asked whether it can solve it.

    Nothing is closer than its margin at the start. A thing is held by a configuration drawn at
    random of those that hold it, and from which some configuration that holds it at the goal is
    known, so that the end, if not the way, is possible.

    Args:
        task: One of `TASKS`.
        seed: Of the random numbers.
        number: Which one; it does not depend on how many there are.

    Raises:
        InputError: Nothing was found.
    """
    rng = np.random.default_rng([seed, list(TASKS).index(task), number])
    if task == "reach":
        layout = sample_layout(_ROOMS + 1000 * seed + number, clutter=number % 10 / 10.0)
        scene = layout.make_scene()
        over = number % 2 == 0
        pose = (
            pose_over(layout, scene, layout.find_part("table_1"), rng)
            if over
            else pose_among(layout, scene, rng)
        )
        return Given(random_start(scene, rng) if scene.start_region else scene, (Reach(pose),))
    joint, goal, state = _HELD[task]
    steps = (Actuate(task, {joint: goal}),)
    for _ in range(_DRAWS):
        scene = load_scene(task).sample_start(rng).with_state(task, dict(state))
        problem = problem_of(Given(scene, (Grasp(task),)))
        for row in _free(problem, rng)[:10]:
            robot = row[: problem.chain.robot.coordinates.size]
            attachment = scene.objects[task].object.attachment().name
            own = Given(
                scene.with_start(base=robot[:3], arm=robot[3:]).with_held({task: attachment}), steps
            )
            held = problem_of(own)
            if compute_shortfall(held, held.start[None], 1)[0] <= 0.0 and len(_free(held, rng)):
                return own
    raise InputError(
        "nothing holds it",
        field=task,
        expected="a free configuration",
        got=f"{_DRAWS} draws without one",
    )


def problem_of(
    own: Given, options: Options | None = None, cache: Cache | None = None
) -> TrajectoryProblem:
    """Return a problem's chain, limits, margins and goals: what all planners are given, whatever they make of it."""
    options = Options() if options is None else options
    return TrajectoryProblem(
        own.scene, compile_task(own.scene, own.steps, options), options, cache=cache
    )


def ends(problem: TrajectoryProblem, rng: np.random.Generator, most: int) -> Floats:
    """Return configurations at the goal that keep their margins, the nearest to the start first, shape (K, n), K ≤ `most`.

    For planners that go from configuration to configuration and have no inverse kinematics of their
    own.
    """
    found = _free(problem, rng)
    if not len(found):
        return found
    found, exact = _exact(problem, found, -1)
    found = found[exact]
    far = np.linalg.norm((found - problem.start) * problem.chain.metric, axis=1)
    return found[np.argsort(far)][:most]


def beginning(problem: TrajectoryProblem) -> Floats:
    """Return the start, shape (n,), where something is held as exactly as planners on manifolds ask for."""
    if not problem.closed(problem.task.phases[0]):
        return problem.start
    found, _ = _exact(problem, problem.start[None], 0)
    return np.asarray(found[0])


def _exact(problem: TrajectoryProblem, z: Floats, row: int) -> tuple[Floats, Bools]:
    """Return configurations next to some, shape (B, n), with an exact pose, within the bounds of a row, and which are."""
    (solver, *_), (target, *_) = problem.transcription.pose_solvers, problem.targets
    limits = {
        "lower": problem.lower[row],
        "upper": problem.upper[row],
        "weights": problem.chain.metric,
    }
    return solver.solve(z, target, **limits, iterations=6, tolerance=_EXACT)


def _free(problem: TrajectoryProblem, rng: np.random.Generator) -> Floats:
    """Return random configurations at the last waypoint, where it should be and free, in the order they were drawn."""
    drawn = sample_goal_configurations(problem, problem.segments, rng)
    assert drawn is not None  # all of these tasks have a pose at the end
    z, error = drawn
    z = z[error < TOLERANCE]
    return np.asarray(z[compute_shortfall(problem, z, problem.segments) <= 0.0])
