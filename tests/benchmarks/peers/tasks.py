"""Defines problems for all planners: reaches, and a door and a drawer grasped at the start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import compute_shortfall, sample_goal_configurations
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.procedural.rooms.random_room import sample_layout
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, Grasp, Reach, Step

from ..problems.poses import (
    sample_pose_among,
    sample_pose_over,
    sample_random_start,
)

TASKS: Mapping[str, str] = {
    "reach": "bring the tool to a pose, base and arm, in a random room",
    "door": "push a door by 1.2 rad whose lever is held",
    "drawer": "pull a drawer out by 0.3 m whose handle is held",
}
"""Task → description."""
_HELD: Mapping[str, tuple[str, float, Mapping[str, float]]] = {
    "door": ("hinge", 1.2, {"knob": 0.55}),
    "drawer": ("slide", 0.3, {}),
}
_EXACT = 1e-7  # [m] and [rad] of goals, as planners on manifolds ask for
_DRAWS = 20  # times that grasps are drawn
_ROOMS = 70_000  # numbers of rooms that nothing else is measured in begin here


@dataclass(frozen=True, eq=False)
class PeerProblem:
    """A problem: its scene and steps; grasped objects are grasped in the scene."""

    scene: Scene
    steps: tuple[Step, ...]


def make_problem(task: str, seed: int, number: int) -> PeerProblem:
    """Return problem `number` of a task, determined by numbers alone.

    The start keeps all margins. A grasp is a random free configuration for which a free goal
    configuration exists.

    Raises:
        InputError: No grasp was found.
    """
    rng = np.random.default_rng([seed, list(TASKS).index(task), number])
    if task == "reach":
        layout = sample_layout(_ROOMS + 1000 * seed + number, clutter=number % 10 / 10.0)
        scene = layout.make_scene()
        over = number % 2 == 0
        pose = (
            sample_pose_over(layout, scene, layout.find_part("table_1"), rng)
            if over
            else sample_pose_among(layout, scene, rng)
        )
        return PeerProblem(
            sample_random_start(scene, rng) if scene.start_region else scene, (Reach(pose),)
        )
    joint, goal, state = _HELD[task]
    steps = (Actuate(task, {joint: goal}),)
    for _ in range(_DRAWS):
        scene = load_scene(task).sample_start(rng).with_state(task, dict(state))
        problem = build_program(PeerProblem(scene, (Grasp(task),)))
        for row in _free(problem, rng)[:10]:
            robot = row[: problem.chain.robot.coordinates.size]
            attachment = scene.objects[task].object.attachment().name
            own = PeerProblem(
                scene.with_start(base=robot[:3], arm=robot[3:]).with_held({task: attachment}), steps
            )
            held = build_program(own)
            if compute_shortfall(held, held.start[None], 1)[0] <= 0.0 and len(_free(held, rng)):
                return own
    raise InputError(
        "nothing holds it",
        field=task,
        expected="a free configuration",
        got=f"{_DRAWS} draws without one",
    )


def build_program(
    own: PeerProblem, options: Options | None = None, cache: Cache | None = None
) -> TrajectoryProblem:
    """Return the program of a problem, which all planners use."""
    options = Options() if options is None else options
    return TrajectoryProblem(
        own.scene, compile_task(own.scene, own.steps, options), options, cache=cache
    )


def sample_goals(problem: TrajectoryProblem, rng: np.random.Generator, most: int) -> Floats:
    """Sample goal configurations that keep their margins, nearest to the start first, (K, n)."""
    if not problem.pose_goals:  # the goal is a configuration
        goal = np.clip(problem.start, problem.lower[-1], problem.upper[-1])[None]
        return goal[compute_shortfall(problem, goal, problem.segments) <= ACCEPTED_SHORTFALL]
    found = _free(problem, rng)
    if not len(found):
        return found
    found, exact = _exact(problem, found, -1)
    found = found[exact]
    far = np.linalg.norm((found - problem.start) * problem.chain.metric, axis=1)
    return found[np.argsort(far)][:most]


def find_exact_start(problem: TrajectoryProblem) -> Floats:
    """Return the start with an exact closure, shape (n,)."""
    if not problem.is_closed(problem.task.phases[0]):
        return problem.start
    found, _ = _exact(problem, problem.start[None], 0)
    return np.asarray(found[0])


def _exact(problem: TrajectoryProblem, z: Floats, row: int) -> tuple[Floats, Bools]:
    """Project configurations (B, n) onto an exact pose in a row's bounds; also return which did."""
    solver, *_ = problem.pose_solvers
    target, *_ = problem.targets
    limits = {
        "lower": problem.lower[row],
        "upper": problem.upper[row],
        "weights": problem.chain.metric,
    }
    return solver.solve(z, target, **limits, iterations=6, tolerance=_EXACT)


def _free(problem: TrajectoryProblem, rng: np.random.Generator) -> Floats:
    """Sample free configurations at the last waypoint."""
    drawn = sample_goal_configurations(problem, problem.segments, rng)
    assert drawn is not None  # all of these tasks have a pose at the end
    z, error = drawn
    z = z[error < TOLERANCE]
    return np.asarray(z[compute_shortfall(problem, z, problem.segments) <= 0.0])
