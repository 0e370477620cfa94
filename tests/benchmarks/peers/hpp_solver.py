"""Solves requests with HPP, in the process of `worker`.

The constraint graph has one state, in which a grasped object stays so, and one transition.
`DiffusingPlanner` grows trees from both ends, and projects their edges. `BiRRTPlanner` does not
project them, so that the configuration may jump. `BiRrtStar` needs more time.
"""

from __future__ import annotations

import ctypes
import time
from typing import Any

import numpy as np

_ITERATIONS = 1_000_000  # of a search, which ends by its time
_PROJECTION = 40  # iterations


class Solver:
    """Solves requests; keeps the problem of the last files."""

    def __init__(self) -> None:
        import pinocchio
        from pyhpp import constraints, core, manipulation
        from pyhpp.manipulation import urdf

        self.pin = pinocchio
        self.core = core
        self.manipulation = manipulation
        self.constraints = constraints
        self.urdf = urdf
        self.files: tuple[str, str] = ("", "")

    def __call__(self, ask: dict[str, Any]) -> dict[str, Any]:
        """Return waypoints, or an error, and times for one goal configuration."""
        if self.files != (ask["urdf"], ask["srdf"]):
            self.load(ask)
            self.files = ask["urdf"], ask["srdf"]
        ctypes.CDLL(None).srand(ask["seed"])  # HPP draws with rand()
        planner = self.manipulation.TransitionPlanner(self.problem)
        planner.setTransition(self.transition)
        inner = planner.innerProblem()
        inner.distance(self.distance)
        steering = inner.steeringMethod()
        planner.pathProjector(self.core.ProgressiveProjector(self.distance, steering, ask["step"]))
        planner.innerPlanner(self.core.DiffusingPlanner(inner))
        planner.maxIterations(_ITERATIONS)
        planner.timeOut(ask["time"])
        start, goal = (self.order(np.array(ask[name])) for name in ("start", "goal"))
        began = time.process_time()
        try:
            path = planner.computePath(start, np.asfortranarray(goal[:, None]), True)
        except (RuntimeError, ValueError) as error:
            return {"error": str(error), "own": time.process_time() - began}
        found = time.process_time() - began
        if path.numberPaths() > 1:  # nothing shortens one segment
            inner.setParameter("PathOptimization/RandomShortcut/NumberOfLoops", ask["shortcuts"])
            shortcuts = self.core.RandomShortcut(inner)
            shortcuts.timeOut(ask["optimizing"])
            path = shortcuts.optimize(path)
        own = time.process_time() - began
        rows = [start]
        for k in range(path.numberPaths()):
            piece = path.pathAtRank(k)
            times = piece.timeRange()
            count = max(1, int(np.ceil(piece.length() / ask["spacing"])))
            for t in np.linspace(times.first, times.second, count + 1)[1:]:
                q, is_projected = piece.eval(float(t))
                if not is_projected:
                    return {"error": "a configuration is off the manifold", "own": own}
                rows.append(q)
        z = np.array(rows)[:, self.columns]
        return {"z": z.tolist(), "own": own, "optimizing": own - found}

    def load(self, ask: dict[str, Any]) -> None:
        """Load a model and build its constraint graph."""
        robot = self.robot = self.manipulation.Device("chain")
        anchored = robot, 0, "", "anchor"
        self.urdf.loadModel(*anchored, ask["urdf"], ask["srdf"], self.pin.SE3.Identity())
        model = robot.model()
        geometry = robot.geomModel()
        joints = [model.getJointId(name) for name in ask["joints"]]
        self.columns = [model.idx_qs[joint] for joint in joints]
        for name, *bounds in zip(ask["joints"], ask["lower"], ask["upper"], strict=True):
            robot.setJointBounds(name, bounds)
        problem = self.problem = self.manipulation.Problem(robot)
        self.distance = self.core.WeighedDistance(robot)
        self.distance.setWeights(self.order(np.array(ask["weights"])))
        problem.distance(self.distance)
        graph = self.graph = self.manipulation.Graph("graph", robot, problem)
        graph.errorThreshold(ask["tolerance"])
        graph.maxIterations(_PROJECTION)
        state = graph.createState("grasped", False, 0)
        self.transition = graph.createTransition(state, state, "move", 1, state)
        if ask["target"] is not None:
            frame = model.frames[model.getFrameId(ask["frame"])]
            target = np.array(ask["target"])
            all_six = [True] * 6
            equal = self.constraints.ComparisonTypes()
            equal[:] = (self.constraints.ComparisonType.EqualToZero,) * 6
            closure = self.constraints.Implicit(
                self.constraints.Transformation(
                    "closure",
                    robot,
                    frame.parentJoint,
                    frame.placement,
                    self.pin.SE3(target[:3, :3], target[:3, 3]),
                    all_six,
                ),
                equal,
                all_six,
            )
            graph.addNumericalConstraintsToState(state, [closure])
            graph.addNumericalConstraintsForPath(state, [closure])
        bodies = {shape.name: shape.parentJoint for shape in geometry.geometryObjects}
        for one, other, margin in ask["margins"]:
            names = (model.names[bodies[f"{link}_0"]] for link in (one, other))
            graph.setSecurityMarginForTransition(self.transition, *names, margin)
        graph.initialize()
        problem.constraintGraph(graph)

    def order(self, z: Any) -> Any:
        """Return coordinates in HPP's order."""
        q = np.empty(len(z))
        q[self.columns] = z
        return q
