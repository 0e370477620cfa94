"""Plans with roboplan: RRT-Connect with projection, or with shortcuts if nothing is grasped.

It reads the chain as URDF. Since it has no clearances, shapes are inflated. Goal configurations
are tried in turn until a motion is accepted.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional

from .description import FRAME, GROUP, describe
from .found import Clock, PeerResult
from .sampled import subdivide
from .tasks import PeerProblem, find_exact_start, sample_goals

_ENDS = 20  # configurations at the goal
_STEP = 0.05  # [m] and [rad] between configurations that are looked at
_NODES = 20_000
_SHARE = 0.2  # of the time that is left, at most, for one configuration at the goal


def plan_by_projection(  # noqa: PLR0915 - sets up one planner, step by step
    own: PeerProblem,
    problem: TrajectoryProblem,
    seed: int,
    clock: Clock,
    accept: Callable[[Floats], bool],
) -> PeerResult:
    """Plan with roboplan; see `found.Peer`."""
    core = import_optional("roboplan.core", "peers", purpose="comparing planners")
    rrt = import_optional("roboplan.rrt", "peers", purpose="comparing planners")
    goals = sample_goals(problem, np.random.default_rng([seed, 1]), _ENDS)
    if not len(goals):
        return PeerResult(status="no configuration at the goal")
    held = problem.is_closed(problem.task.phases[0])
    with tempfile.TemporaryDirectory() as folder:
        files = describe(problem, Path(folder))
        scene = core.Scene("chain", core.loadUrdfSceneDescription(str(files.urdf)))
        scene.importSrdf(files.srdf.read_text(encoding="utf-8"))
    scene.setRngSeed(seed)
    order = [list(scene.getJointNames()).index(name) for name in files.joints]

    def there(z: Floats) -> Floats:
        q = np.zeros(len(z))
        q[order] = z
        return q

    constraints = []
    if held:
        tight = {"position_tolerance": 1e-4, "orientation_tolerance": 1e-4}
        zeros = np.zeros(6)
        target = np.asfortranarray(problem.targets[0].homogeneous)
        pose = rrt.PoseConstraint(scene, GROUP, FRAME, zeros, zeros, target, "", **tight)
        constraints.append(pose)
    found = PeerResult(status="no path")
    names = list(scene.getJointNames())
    start = core.JointConfiguration(names, there(find_exact_start(problem)))
    for row in goals:
        if clock.remaining <= 0.0:
            found.status = "timed out"
            break
        options = rrt.RRTOptions(
            group_name=GROUP,
            max_nodes=_NODES,
            max_connection_distance=1.0,
            collision_check_step_size=_STEP,
            collision_check_use_bisection=True,
            max_planning_time=max(0.1, _SHARE * clock.remaining),
            rrt_connect=True,
        )
        options.constraint_projection.path_step_size = 0.1
        planner = rrt.RRT(scene, options)
        planner.setRngSeed(seed)
        began = time.process_time()
        try:
            path = planner.plan(start, core.JointConfiguration(names, there(row)), constraints)
        except RuntimeError as error:
            found.about["said"] = str(error)
            continue
        finally:
            found.own += time.process_time() - began
        found.first = clock.cpu_time if found.first is None else found.first
        if not held:
            began = time.process_time()
            shortcuts = core.PathShortcuttingOptions(
                group_name=GROUP, max_step_size=_STEP, max_iters=1000, seed=seed
            )
            path = core.PathShortcutter(scene, shortcuts).shortcut(path)
            found.own += time.process_time() - began
        rows = np.array(path.positions)[:, order]
        rows[0] = problem.start
        found.path = subdivide(rows, problem.chain.metric)
        found.status = "found"
        if accept(found.path):
            break
    return found
