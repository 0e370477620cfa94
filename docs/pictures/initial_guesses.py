"""Makes docs/images/held.png: initial guesses for closing a narrow door, seen from above."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pinocchio as pin

import vkc_pin as vkc
from docs.pictures import IMAGES
from vkc_pin.experiments import chores
from vkc_pin.planning.initialization import closed_trees, interpolation
from vkc_pin.planning.initialization.keyframes import compute_shortfall
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.obstacles import FLOOR

EVERY = 6  # of the waypoints that are drawn


def make() -> None:
    """Draw a narrow door being closed: interpolated between keyframes, and by random trees."""
    scene = (
        chores.make_cluttered_home()
        .with_state("door", {"hinge": 1.52})
        .with_start(base=(1.2, 2.6, -1.57))
    )
    seen: list[tuple[TrajectoryProblem, list[np.ndarray]]] = []
    search = interpolation.RrtPaths.find_closed_path

    def record(
        paths: interpolation.RrtPaths, phase: int, through: np.ndarray, straight: np.ndarray
    ) -> np.ndarray | None:
        path, sampler = search(paths, phase, through, straight), paths.sampler
        if path is not None:
            own = closed_trees._ClosedSearch(sampler, phase, through, len(straight))
            closed, _ = own.project(straight, np.arange(own.begin + 1.0, own.end + 1.0))
            seen.append((sampler.problem, [closed, path]))
        return path

    interpolation.RrtPaths.find_closed_path = record
    step = vkc.Actuate("door", {"hinge": 0.0}, "handle_free")
    plan = vkc.plan(scene, [step], options=chores.CHORES["cluttered"].options, initialization="rrt")
    interpolation.RrtPaths.find_closed_path = search
    sys.stdout.write(plan.summary() + "\n")
    problem, paths = seen[-1]
    phase = len(problem.task.phases) - 1
    with use_style():
        figure = new_figure(8.0, 3.9)
        for number, (path, title) in enumerate(
            zip(paths, ("straight between keyframes", "along the trees' path"), strict=True)
        ):
            axes = figure.add_subplot(1, 2, number + 1)
            short = (
                compute_shortfall(problem, path, problem.contacts.find_waypoint(phase), reach=0.0)
                - problem.options.dist_safe
            )
            draw_path(axes, problem, path, int(np.argmax(short)) if short.max() > 0.0 else None)
            overlap = (
                f"{1e3 * short.max():.0f} mm inside at most"
                if short.max() > 0.0
                else "nothing overlaps"
            )
            axes.set_title(f"{title}: {overlap}")
        save_figure(figure, IMAGES / "held.png")


def draw_path(axes: Any, problem: TrajectoryProblem, path: np.ndarray, worst: int | None) -> None:
    """Draw walls, arm and door leaf at some waypoints, the worst one in another colour."""
    from matplotlib.colors import to_rgb
    from scipy.spatial import ConvexHull

    part = problem.contacts.phases[len(problem.task.phases) - 1]
    rotations, translations = problem.chain.joint_placements(path)
    shown = [*range(0, len(path), EVERY), *([] if worst is None else [worst])]
    for shape, label in zip(part.shapes, part.labels, strict=True):
        points = triangulate(shape.geometry)[0]
        for k in shown if shape.parentJoint else [0]:
            placed = (
                pin.SE3(rotations[k, shape.parentJoint], translations[k, shape.parentJoint])
                * shape.placement
            )
            at = points @ placed.rotation.T + placed.translation
            arm = 1 < shape.parentJoint < 8
            if label == FLOOR or (
                not arm and not 0.5 < at[:, 2].min() + 0.5 * np.ptp(at[:, 2]) < 1.5
            ):
                continue
            outline = at[ConvexHull(at[:, :2]).vertices, :2]
            if shape.parentJoint == 0:
                axes.fill(*outline.T, facecolor="0.75", edgecolor="0.5", linewidth=0.5)
            elif arm or label.startswith("door"):
                colour = COLOURS[1] if k == worst else COLOURS[0] if arm else "0.4"
                axes.fill(
                    *outline.T,
                    facecolor=(*to_rgb(colour), 0.12),
                    edgecolor=colour,
                    linewidth=1.0 if k == worst else 0.6,
                )
    axes.set(xlim=(0.9, 2.3), ylim=(0.45, 2.05), aspect="equal", xlabel="x [m]", ylabel="y [m]")
