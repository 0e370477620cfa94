"""Solves requests with trajopt of tesseract, in the process of `worker`."""

from __future__ import annotations

import ctypes
import importlib.util
import time
from pathlib import Path
from typing import Any


class Solver:
    """Solves requests; keeps the environment of the last files."""

    def __init__(self) -> None:
        found = importlib.util.find_spec("tesseract_robotics")
        if found is None or found.origin is None:
            raise ModuleNotFoundError("tesseract_robotics is not installed")
        bundled = Path(found.origin).parent / "libstdc++.so.6"
        if bundled.is_file():  # the wheel needs its own C++ library, loaded before all others
            ctypes.CDLL(str(bundled), mode=ctypes.RTLD_GLOBAL)
        from tesseract_robotics import (
            tesseract_collision,
            tesseract_common,
            tesseract_environment,
            trajopt_ifopt,
            trajopt_sqp,
        )

        self.ti = trajopt_ifopt
        self.sqp = trajopt_sqp
        self.common = tesseract_common
        self.collision = tesseract_collision
        self.environment_module = tesseract_environment
        self.files: tuple[str, str] = ("", "")
        self.environment: Any = None

    def __call__(  # noqa: PLR0915 - sets up one problem, step by step
        self, ask: dict[str, Any]
    ) -> dict[str, Any]:
        """Return waypoints, status and time for one initial guess."""
        import numpy as np

        ti = self.ti
        sqp = self.sqp
        files = ask["urdf"], ask["srdf"]
        if self.files != files:
            locator = self.common.GeneralResourceLocator()
            environment = self.environment_module.Environment()
            texts = [Path(file).read_text(encoding="utf-8") for file in files]
            if not environment.initFromUrdfSrdf(*texts, locator):
                return {"error": "the description is refused"}
            self.files = files
            self.environment = environment
            self.locator = locator
        group = self.environment.getJointGroup(ask["group"])
        names = list(group.getJointNames())
        order = [ask["joints"].index(name) for name in names]
        seed = np.array(ask["seed"])[:, order]
        weights = np.array(ask["weights"])[order]
        steps = len(seed)
        limits = np.column_stack([np.array(ask["lower"])[order], np.array(ask["upper"])[order]])
        variables = ti.createNodesVariables("motion", names, list(seed), ti.toBounds(limits))
        nlp = sqp.IfoptProblem(variables)
        at = [node.getVar("joints") for node in variables.getNodes()]
        kept: list[Any] = []

        def constrain(one: Any) -> None:
            kept.append(one)
            nlp.addConstraintSet(one)

        constrain(ti.JointPosConstraint(seed[0], at[0], np.full(len(names), 5.0), "start"))
        same = self.common.Isometry3d.Identity()
        target = self.common.Isometry3d(np.asfortranarray(ask["target"]))
        for k in ask["at"]:
            constrain(
                ti.CartPosConstraint(at[k], group, ask["frame"], "world", same, target, f"pose_{k}")
            )
        if ask["goal"]:
            goal = seed[-1].copy()
            # Weights of 0 are refused; these let the other joints be anywhere.
            asked = np.full(len(names), 1e-5)
            for name, value in ask["goal"].items():
                goal[names.index(name)] = value
                asked[names.index(name)] = 5.0
            constrain(ti.JointPosConstraint(goal, at[-1], asked, "goal"))
        for cost in (
            ti.JointVelConstraint(np.zeros(len(names)), at, weights, "velocity"),
            ti.JointAccelConstraint(np.zeros(len(names)), at, weights, "acceleration"),
        ):
            kept.append(cost)
            nlp.addCostSet(cost)
        problem = sqp.IfoptQPProblem(nlp)
        config = ti.TrajOptCollisionConfig(ask["margin"], 20.0)
        config.collision_margin_buffer = ask["buffer"]
        check = config.collision_check_config
        check.type = self.collision.CollisionEvaluatorType.LVS_CONTINUOUS
        check.longest_valid_segment_length = ask["longest"]
        config.collision_check_config = check
        for k in range(1, steps):
            evaluator = ti.LVSContinuousCollisionEvaluator(group, self.environment, config)
            one = ti.ContinuousCollisionConstraint(
                evaluator, at[k - 1], at[k], k == 1, False, ask["contacts"], False, f"hit_{k}"
            )
            kept += [evaluator, one]
            problem.addConstraintSet(one)
        problem.setup()
        solver = sqp.TrustRegionSQPSolver(sqp.OSQPEigenSolver())
        for name, value in ask["parameters"].items():
            setattr(solver.params, name, value)
        began = time.process_time()
        solver.solve(problem)
        own = time.process_time() - began
        z = np.asarray(solver.getResults().best_var_vals)[: steps * len(names)].reshape(
            steps, len(names)
        )
        back = np.empty_like(z)
        back[:, order] = z
        return {"z": back.tolist(), "status": solver.getStatus().name, "own": own}
