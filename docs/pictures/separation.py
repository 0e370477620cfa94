"""Makes docs/images/separation.png: a straight guess through a box, and rounds of the solver."""

from __future__ import annotations

import sys

import numpy as np
from scipy.spatial import ConvexHull

import vkc_pin as vkc
from docs.pictures import IMAGES
from vkc_pin.experiments.initialization import TARGET
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.loop import solve
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.task.compiler import compile_task

ROUNDS = (1, 3, 6)


def make() -> None:
    """Draw the path of the base in some rounds."""
    scene, options = vkc.load_scene("init_2"), vkc.Options()
    scene = scene.sample_start(np.random.default_rng(5))
    task = compile_task(scene, [vkc.Grasp("stick"), vkc.Touch("stick.tip", TARGET)], options)
    problem = TrajectoryProblem(scene, task, options)
    guess = next(initialize(problem, "interpolated", 0)).z
    found = solve(problem, guess)
    sys.stdout.write(f"{found.status} after {found.rounds} rounds\n")
    paths = [("guess", guess)]
    paths += [(f"round {k}", solve(problem, guess, rounds=k).z) for k in ROUNDS if k < found.rounds]
    paths += [(f"round {found.rounds}", found.z)]
    with use_style():
        figure = new_figure(4.4, 4.8)
        axes = figure.add_subplot()
        part = problem.contacts.phases[0]
        for shape, label in zip(part.shapes, part.labels, strict=True):
            if shape.parentJoint == 0 and label != FLOOR:
                points = triangulate(shape.geometry)[0]
                at = points @ shape.placement.rotation.T + shape.placement.translation
                outline = at[ConvexHull(at[:, :2]).vertices, :2]
                axes.fill(*outline.T, facecolor="0.8", edgecolor="0.5", linewidth=0.5)
        for number, (name, z) in enumerate(paths):
            path = problem.waypoints(z)
            colour = "0.4" if number == 0 else COLOURS[number - 1]
            axes.plot(*path[:, :2].T, ".-", color=colour, label=name, linewidth=1.0, markersize=3.0)
        axes.legend(loc="best")
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        save_figure(figure, IMAGES / "separation.png")
