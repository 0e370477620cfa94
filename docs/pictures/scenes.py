"""Makes pictures and animations of plans, scenes, imports and bases. Needs Chromium."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pinocchio as pin
from helpers.browser import save_screenshot
from helpers.door_closers import load_door_with_closer
from helpers.grippers import write_cheeks_scene, write_gripper
from helpers.homes import write_home_urdf

import vkc_pin as vkc
from docs.pictures import DOCS, IMAGES, ROOT
from tests.benchmarks import gap
from vkc_pin.experiments import chores
from vkc_pin.importing.pictures import plot_attachments
from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization import drawing
from vkc_pin.visualization import viewer as visualization
from vkc_pin.visualization.camera import LANDSCAPE, choose_viewpoint
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.visualization.plots.top_view import draw_top_view
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.trajectory.torques import Torques
from vkc_pin.world.trajectory.world_model import World

WIDE, SMALL = (1200, 640), (640, 400)  # [pixels]
SHOWN = 0  # number of the start from which the robot drives through the gap
LEAVING = 0.6  # share of the duration of the task in the home
HALF_OPEN = 0.78  # share of the duration at the door
UNDER_THE_TABLE = (-0.4, 2.4, 0.4), (-4.2, -0.6, 2.0)  # what to look at, and from where [m]
WHOLE_ROOM = (0.5, 0.3, 0.0), (-8.6, -5.4, 5.4)
CORRIDOR = (1.6, 0.0, 0.3), (-7.4, -1.4, 7.2)
AISLE = (2.35, 2.5, 0.2), (-2.9, -3.0, 6.2)
HOME = (0.1, -0.3, 0.0), (-1.5, -8.5, 9.0)
KITCHEN = (-2.1, 2.4, 0.7), (0.1, -1.0, 2.9)
SHELF = (0.5, 0.05, 0.3), (-0.5, -1.35, 0.95)
TRAY = (0.0, -0.5, 0.5), (-3.2, -2.6, 2.6)
PUSHED = (2.3, -0.2, 0.8), (-0.5, -2.6, 2.9)
PUSHING = 0.7  # share of the duration at the open door
CARRIED = 0.75  # share of the duration with the tray
FINGERS = 0.04  # [m] between them
GAP = (0.1, -0.3, 0.2), (-3.4, -5.0, 5.6)
FURNITURE = {  # kinds, and the seeds of those that are shown
    **{"door": 1, "drawers": 2, "cabinet": 1, "refrigerator": 2, "dishwasher": 0},
    **{"oven": 1, "microwave": 0, "chest": 0, "faucet": 1, "valve": 2},
}
TASKS = (5, 49, 40, 54)  # a door, a refrigerator, a chest, an oven
OPENED = {
    "door": ("hinge", 1.0),
    "drawer": ("slide", 0.22),
    "dishwasher": ("rack", 0.5),
    "refrigerator": ("hinge", 1.4),
}


def look(target: tuple[float, ...], position: tuple[float, ...]) -> None:
    """Take this camera instead of one that is chosen for the motion, but on telephones."""

    def choose(points: Floats, boxes: Any, aspect: float = LANDSCAPE) -> tuple[Floats, Floats]:
        if aspect < 1.0:
            return choose_viewpoint(points, boxes, aspect)
        return np.array(target), np.array(position)

    drawing.choose_viewpoint = choose


def picture(
    shown: vkc.Plan | vkc.Scene, name: str, size: tuple[int, int], share: float | None = None
) -> None:
    """Write the picture of a plan after a share of its duration, or of a scene."""
    time = None
    if share is not None:
        assert isinstance(shown, vkc.Plan)
        time = share * float(shown.trajectory.times[-1])
    with tempfile.TemporaryDirectory() as folder:
        save_screenshot(
            visualization.to_html(shown, Path(folder) / "page.html"),
            IMAGES / f"{name}.png",
            time=time,
            size=size,
        )


def attachments() -> None:
    """Write the picture of proposed attachments."""
    plot_attachments(
        vkc.importing.propose_attachments(vkc.load_object("dishwasher"), most=2),
        IMAGES / "attachments.png",
    )


def plots(plan: vkc.Plan, prefix: str, *names: str) -> None:
    """Write some of a plan's plots."""
    with tempfile.TemporaryDirectory() as folder:
        plan.plot(folder)
        for name in names:
            (IMAGES / f"{prefix}_{name}.png").write_bytes(
                (Path(folder) / f"{name}.png").read_bytes()
            )


def home_pictures() -> None:
    """Write the pictures of the home, as it is and with its doors open."""
    home = vkc.load_scene("household")
    look(*HOME)
    picture(home, "household", WIDE)
    for name, (joint, value) in OPENED.items():
        home = home.with_state(name, {joint: value})
    look(*KITCHEN)
    picture(home, "household_kitchen", SMALL)


def cluttered_picture() -> None:
    """Write the picture of the home that is as full and as tight as real ones."""
    look(*HOME)
    picture(chores.make_cluttered_home(), "household_cluttered", WIDE)


def room_picture() -> None:
    """Write random rooms from above, with little and with much in them."""
    rooms = [
        vkc.procedural.random_room(number, clutter=clutter)
        for number, clutter in ((3, 0.2), (1, 0.5), (2, 0.9))
    ]
    with use_style():
        figure = new_figure(12.0, 4.4)
        for own, room in zip(figure.subfigures(1, len(rooms)), rooms, strict=True):
            draw_top_view(own, World(room), None)
        save_figure(figure, IMAGES / "random_rooms.png")


def furniture_picture() -> None:
    """Write one of every kind of furniture that is made at random, with its joints half open."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    light = np.array([-0.6, -0.35, 0.72])
    with use_style():
        figure = new_figure(12.0, 5.6)
        for place, (kind, seed) in enumerate(FURNITURE.items(), start=1):
            item = vkc.load_object(vkc.procedural.random_object(kind, seed))
            state = np.array(
                [
                    0.0 if name == "knob" else 0.5 * high
                    for name, high in zip(item.coordinates.names, item.upper, strict=True)
                ]
            )
            shapes = make_world_shapes(
                vkc.PlacedObject(kind, item, pin.SE3.Identity(), state), visual=True
            )
            faces, colours = list[np.ndarray](), list[np.ndarray]()
            for shape in shapes:
                points, corners = triangulate(shape.geometry)
                points = points @ shape.placement.rotation.T + shape.placement.translation
                for face in points[corners]:
                    normal = np.cross(face[1] - face[0], face[2] - face[0])
                    size = np.linalg.norm(normal)
                    shade = 0.55 + 0.45 * abs(float(normal @ light)) / size if size > 0.0 else 1.0
                    faces += finer(face)
                    colours += [np.append(shade * shape.meshColor[:3], 1.0)] * (
                        len(faces) - len(colours)
                    )
            axes = figure.add_subplot(2, 5, place, projection="3d", computed_zorder=False)
            axes.add_collection3d(
                Poly3DCollection(
                    np.array(faces), facecolors=colours, edgecolors=colours, linewidths=0.2
                )
            )
            corners = np.array(faces).reshape(-1, 3)
            middle = (corners.max(axis=0) + corners.min(axis=0)) / 2
            half = np.ptp(corners, axis=0).max() / 2
            for axis, value in zip("xyz", middle, strict=True):
                getattr(axes, f"set_{axis}lim")(value - half, value + half)
            axes.view_init(elev=22, azim=-145)
            axes.set_box_aspect((1, 1, 1), zoom=1.25)
            axes.set_axis_off()
            axes.set_title(kind, y=-0.05)
        save_figure(figure, IMAGES / "furniture.png")


def finer(face: np.ndarray, longest: float = 0.06) -> list[np.ndarray]:
    """Split a triangle until no edge is longer [m]: the picture sorts triangles by depth."""
    edges = [np.linalg.norm(face[k] - face[k - 1]) for k in range(3)]
    k = int(np.argmax(edges))
    if edges[k] <= longest:
        return [face]
    a, b, c = face[k - 1], face[k], face[k - 2]
    middle = (a + b) / 2
    return [*finer(np.array([a, middle, c]), longest), *finer(np.array([middle, b, c]), longest)]


def task_picture() -> None:
    """Write tasks in random rooms from above, with the motions that were planned for them."""
    with use_style():
        figure = new_figure(12.0, 8.4)
        for own, seed in zip(figure.subfigures(2, 2).ravel(), TASKS, strict=True):
            room, steps = vkc.procedural.random_task(seed)
            plan = vkc.plan(room, steps)
            sys.stdout.write(plan.summary() + "\n")
            draw_top_view(own, World(room), plan.trajectory)
        save_figure(figure, IMAGES / "random_tasks.png")


def check_picture() -> None:
    """The home with the approaches to all that can be taken hold of."""
    vkc.check_scene(vkc.load_scene("household")).plot(IMAGES / "scene_check.png")


def import_picture() -> None:
    """Draw a home of three rooms imported from one URDF, and a motion that opens its fridge."""
    with tempfile.TemporaryDirectory() as folder:
        file, _ = write_home_urdf(Path(folder))
        scene = vkc.importing.import_home(file, Path(folder) / "out").scene
        plan = vkc.plan(scene, [vkc.Actuate("refrigerator_body", {"refrigerator_hinge": 0.94})])
        sys.stdout.write(plan.summary() + "\n")
        with use_style():
            figure = new_figure(8.0, 6.6)
            draw_top_view(figure, World(scene), plan.trajectory)
            save_figure(figure, IMAGES / "import_home.png")


def chore_pictures(chore: vkc.Plan) -> None:
    """Write a picture of the chore in the home, and the page that shows all of it."""
    look(*HOME)
    picture(chore, "household_chore", WIDE, LEAVING)
    visualization.to_html(chore, DOCS / "animations" / "household_chore.html")


def gap_picture(through: vkc.Plan) -> None:
    """Write a picture of the motion through the gap, when the robot is in it."""
    look(*GAP)
    inside = int(np.argmax(through.trajectory.column("base_x") > 0.0))
    times = through.trajectory.times
    picture(through, "gap_table", WIDE, float(times[inside] / times[-1]))


def arm_picture() -> None:
    """Write a picture of an arm in a shelf, with the plan of a notebook."""
    notebook = nbformat.read(ROOT / "notebooks" / "11_problems_of_others.ipynb", as_version=4)
    cells = {cell.id: cell.source for cell in notebook.cells}
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for cell in ("problem", "plan"):
            exec(cells[cell], names)
    look(*SHELF)
    picture(names["plan"], "arm_in_clutter", WIDE, 1.0)


def tray_picture() -> None:
    """Write a picture of a carried tray."""
    look(*TRAY)
    picture(
        vkc.plan(vkc.load_scene("tray"), [vkc.Place("tray", [-0.3, -1.96, 0.7])]),
        "tray",
        SMALL,
        CARRIED,
    )


def push_picture() -> None:
    """Write a picture of a door that is pushed shut."""
    look(*PUSHED)
    scene = vkc.load_scene("door").with_state("door", {"hinge": -1.2})
    picture(
        vkc.plan(scene, [vkc.Actuate("door", {"hinge": 0.0}, "push")]), "pushing", SMALL, PUSHING
    )


def bases_picture() -> None:
    """Draw the door opened by a differential drive and by a car-like base, seen from above."""
    scene = vkc.load_scene("door")
    shown = ({"base": "differential"}, {"base": "ackermann", "turning_radius": 0.8})
    with use_style():
        figure = new_figure(11.0, 3.5)
        parts = figure.subfigures(1, 2)
        for part, robot in zip(parts, shown, strict=True):
            document = {**scene.document, "robot": {"name": "husky_ur5e", **robot}}
            plan = vkc.plan(
                vkc.Scene.from_document(document, scene.folder),
                [vkc.Actuate("door", {"hinge": 1.2})],
            )
            sys.stdout.write(plan.summary() + "\n")
            draw_top_view(part, World(plan.scene), plan.trajectory)
        save_figure(figure, IMAGES / "bases.png")


def pull_picture() -> None:
    """Draw a door that is pulled open, from above: alone, and to drive through afterwards."""
    scene, pull = vkc.load_scene("door"), vkc.Actuate("door", {"hinge": -1.5})
    with use_style():
        figure = new_figure(11.0, 3.5)
        tasks = [pull], [pull, vkc.GoTo(4.1, -0.3)]
        for part, steps in zip(figure.subfigures(1, 2), tasks, strict=True):
            plan = vkc.plan(scene, steps)
            sys.stdout.write(plan.summary() + "\n")
            draw_top_view(part, World(scene), plan.trajectory)
        save_figure(figure, IMAGES / "pulled_door.png")


def opening_picture() -> None:
    """Draw fingers between two cheeks, from above: fully open, and at the attachment's opening."""
    from scipy.spatial import ConvexHull

    with tempfile.TemporaryDirectory() as folder, use_style():
        scene = write_cheeks_scene(write_gripper(Path(folder)), opening=FINGERS)
        plan = vkc.plan(scene, [vkc.Grasp("drawer")])
        sys.stdout.write(plan.summary() + "\n")
        world, figure = World(scene), new_figure(8.0, 3.4)
        row = world.compute_positions(plan.trajectory)[-1]
        first = world.coordinates.index("finger_a_joint")
        for number, opening in enumerate((None, FINGERS)):
            row[first : first + 2] = scene.robot.gripper.compute_positions(opening)
            data = world.model.createData()
            pin.forwardKinematics(world.model, data, world.coordinates.q(row))
            axes = figure.add_subplot(1, 2, number + 1)
            for shape, label in zip(world.shapes, world.collision_labels, strict=True):
                if label == "floor" or label.startswith(("body", "arm_1", "arm_2", "arm_3")):
                    continue
                points = triangulate(shape.geometry)[0]
                placed = data.oMi[shape.parentJoint] * shape.placement
                outline = (points @ placed.rotation.T + placed.translation)[:, :2]
                outline = outline[ConvexHull(outline).vertices]
                colour = (
                    "0.75"
                    if label in scene.obstacle_labels
                    else COLOURS[label.startswith("drawer")]
                )
                axes.fill(
                    -outline[:, 1], outline[:, 0], facecolor=colour, edgecolor="0.25", linewidth=0.8
                )
            wide = scene.robot.gripper.rest_opening if opening is None else opening
            axes.set_title("fully open" if opening is None else f"opening: {opening:g}")
            finger, cheek = -wide / 2.0 - 0.01, -0.06  # outer and inner face [m]
            axes.annotate(
                "",
                (cheek, 1.15),
                (finger, 1.15),
                arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0},
            )
            axes.text(-0.045, 1.208, f"{1e3 * (finger - cheek):.0f} mm", ha="right", fontsize=9)
            axes.set(xlim=(-0.13, 0.13), ylim=(1.0, 1.24), aspect="equal", xlabel="m")
        save_figure(figure, IMAGES / "opening.png")


def torque_picture() -> None:
    """Draw the motor torques over time, with their limits, while opening a door with a closer."""
    scenes = (
        vkc.load_scene("door"),
        load_door_with_closer(damping=400.0, stiffness=5.0, springref=-2.0),
    )
    plans = [vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2}, "handle")]) for scene in scenes]
    with use_style():
        figure = new_figure(9.0, 3.4)
        panels = figure.subplots(1, 2, sharey=True)
        for axes, plan, title in zip(
            panels, plans, ("as it is", "with a closer that damps by 400 N·m·s/rad"), strict=True
        ):
            times, _ = plan.trajectory.sample(200.0)
            torques = Torques(plan.scene, plan.trajectory)
            limits = plan.scene.robot.torque_limits.limits[3:]
            shares = 100.0 * torques.along(times)[:, 3:] / limits
            for name, column, limit in zip(
                plan.scene.robot.coordinates.names[3:], shares.T, limits, strict=True
            ):
                axes.plot(times, column, label=f"{name.removesuffix('_joint')}, {limit:g} N·m")
            for edge in (-100.0, 100.0):
                axes.axhline(edge, color="0.3", linestyle="--", linewidth=1.0)
            axes.set(title=f"a door {title}", xlabel="time [s]", ylim=(-112.0, 112.0))
        panels[0].set_ylabel("torque [% of the limit]")
        panels[0].legend(fontsize=7, ncols=2, loc="upper left", bbox_to_anchor=(0.0, 0.9))
        save_figure(figure, IMAGES / "torques.png")


def make() -> None:
    """Write the pictures."""
    use = [vkc.Grasp("stick"), vkc.Touch("stick.tip", (-1, 3.897, 0.1))]
    door = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})])
    stick = vkc.plan(vkc.load_scene("init_3"), use, initialization="astar")
    home = vkc.load_scene("household")
    chore = vkc.plan(home, chores.home(home), window=2)
    through = vkc.plan(gap.make_start(0, SHOWN), [vkc.Reach(gap.POSE)])
    for plan in (door, stick, chore, through):
        sys.stdout.write(plan.summary() + "\n")
        if not plan.success:
            raise SystemExit("there is no motion to show")
    attachments()
    picture(door, "door", WIDE, HALF_OPEN)
    plots(door, "door", "joints")
    door.simulate().plot(IMAGES / "physics.png")
    plots(stick, "stick", "top_view")
    look(*UNDER_THE_TABLE)
    picture(stick, "stick", WIDE, 1.0)
    look(*WHOLE_ROOM)
    for name in ("init_1", "init_2", "init_3"):
        picture(vkc.load_scene(name), name, SMALL)
    for name, camera in (("corridor_door", CORRIDOR), ("aisle_drawer", AISLE)):
        look(*camera)
        picture(vkc.load_scene(name), name, SMALL)
    home_pictures()
    cluttered_picture()
    room_picture()
    furniture_picture()
    task_picture()
    check_picture()
    import_picture()
    chore_pictures(chore)
    gap_picture(through)
    arm_picture()
    tray_picture()
    push_picture()
    bases_picture()
    pull_picture()
    opening_picture()
    torque_picture()
