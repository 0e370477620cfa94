"""Makes scenes with a stick and a ball, and unplanned motions that carry them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin

from helpers.drives import DT, make_hall, make_scene
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.scene.hold import make_holds
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

# Along y, its tip to the left; its discs reach 0.05 m below it.
STICK = pin.SE3(np.eye(3), np.array([0.8, 0.0, 0.55]))
TOP = 0.5  # height of the table [m]
# The tip of a stick grasped at this height touches it.
BALL = pin.SE3(np.eye(3), np.array([0.8, 0.285, 0.7]))
# The hand is above the table, pointing down.
GUESS = np.array([0.0, 0.0, 0.0, 0.07, -1.69, -1.39, -1.63, 1.57, -1.5])
UP = np.array([0.0, 0.0, 0.2])
FREE = {"stick": STICK, "ball": BALL}


def describe_box(name: str, size: Sequence[float], position: Sequence[float]) -> dict[str, Any]:
    return {"name": name, "type": "box", "size": list(size), "position": list(position)}


def describe_table(*, gap: float = 1e-3) -> dict[str, Any]:
    """Return a table of 0.5 m x 2.4 m whose top is `gap` below the stick's discs."""
    return describe_box("table", [0.5, 2.4, 0.02], [0.8, 0.3, TOP - gap - 0.01])


def describe_stand(name: str = "stand", *, aside: float = 0.0, gap: float = 1e-3) -> dict[str, Any]:
    """Return a post `gap` [m] below the ball, shifted by `aside` [m] along y."""
    return describe_box(name, [0.06, 0.06, 0.5], [0.8, 0.285 + aside, 0.665 - gap - 0.25])


def make_room(
    *obstacles: Mapping[str, Any], objects: Sequence[str] = ("stick",), base: str = "omni"
) -> Scene:
    """Return a hall with obstacles and free objects; the hand is 0.2 m above the stick's grasp."""
    scene = make_hall(base=base, obstacles=obstacles)
    document = {
        **scene.document,
        "objects": [{"name": n, "type": n, "position": _get_position(n)} for n in objects],
    }
    scene = make_scene(document)
    return scene.with_start(arm=solve_above(STICK)[3:]) if "stick" in objects else scene


def _get_position(name: str) -> list[float]:
    return [float(value) for value in FREE[name].translation]


def lift(placement: pin.SE3, shift: Sequence[float] | np.ndarray = UP) -> pin.SE3:
    """Return `placement` moved by `shift` in the world [m]."""
    return pin.SE3(placement.rotation, placement.translation + np.asarray(shift))


def compute_grasp_pose(
    object_at: pin.SE3,
    name: str = "stick",
    attachment: str = "grip",
    values: Sequence[float] = (0.0, 0.0),
) -> pin.SE3:
    """Return the pose of the hand that grasps a one-link object at `object_at`, by definition."""
    grasp = load_object(name).attachment(attachment)
    return (
        object_at
        * grasp.placement
        * compute_freedom(attachment, values)
        * pin.SE3(np.eye(3), np.array([0.0, 0.0, -grasp.standoff]))
    )


def compute_freedom(attachment: str, values: Sequence[float]) -> pin.SE3:
    """Return the freedom J(v) of an attachment of stick or ball, from their files."""
    if attachment == "end":
        return pin.SE3.Identity()
    if len(values) == 2:  # slides along −y, and turns about it
        slide, turn = values
        return pin.SE3(pin.utils.rotate("y", -turn), np.array([0.0, -slide, 0.0]))
    x, y, z = values
    return pin.SE3(
        pin.utils.rotate("x", x) @ pin.utils.rotate("y", y) @ pin.utils.rotate("z", z), np.zeros(3)
    )


def solve_reach(tool: pin.SE3, guess: np.ndarray = GUESS) -> np.ndarray:
    """Return robot coordinates that reach `tool`, shape (9,), with the base of `guess`.

    Newton's method on numeric Pinocchio starts at `guess`, then at random points around it.
    """
    robot = make_hall().robot
    rng = np.random.default_rng(0)
    model = robot.model
    data = robot.model.createData()
    frame = model.getFrameId(robot.tool_frame)
    found = []
    for spread in (0.0, *np.linspace(0.1, 0.8, 40)):
        z = np.array(guess)
        z[3:] += spread * rng.normal(size=6)
        for _ in range(60):
            q = robot.coordinates.q(z)
            pin.computeJointJacobians(model, data, q)
            error = pin.log6(pin.updateFramePlacement(model, data, frame).actInv(tool)).vector
            if np.abs(error).max() < 1e-13:
                break
            jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL)[:, 3:]
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-12 * np.eye(6), error)
            z[3:] += step * min(1.0, 0.5 / np.abs(step).max())
        if np.abs(error).max() < 1e-12 and (z >= robot.lower).all() and (z <= robot.upper).all():
            found.append(z)
            if not spread:
                break
    return min(found, key=lambda z: float(np.abs(z - guess).sum()))


@cache
def _make_guess_above() -> np.ndarray:
    return solve_reach(compute_grasp_pose(lift(STICK)))


def solve_above(stick: pin.SE3, **grasp: Any) -> np.ndarray:
    """Return robot coordinates with the hand 0.2 m above the grasp of the stick at `stick`."""
    return solve_reach(compute_grasp_pose(lift(stick), **grasp), _make_guess_above())


def solve_grasp() -> np.ndarray:
    """Return robot coordinates with the hand at the grasp of the stick on the table."""
    return solve_reach(compute_grasp_pose(STICK), solve_above(STICK))


@dataclasses.dataclass
class MotionBuilder:
    """Builds a motion from grasps and robot configurations.

    Attributes:
        scene: Scene of the motion, which begins at the scene's start.
        values: Grasp coordinate → value, constant along the motion.
    """

    scene: Scene
    values: dict[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rows = [np.array(self.scene.start)]
        self.phases: list[PhaseSpan] = []
        self.held = self.scene.held
        self.by = {hold.object: str(hold.frame) for hold in self.scene.holds if hold.by}
        for hold in self.scene.holds:
            self._set(hold.object, hold.attachment, hold.at)

    def _set(self, name: str, attachment: str, values: Sequence[float]) -> None:
        grasp = self.scene.objects[name].object.attachment(attachment)
        self.values |= {f"{name}.{c}": v for c, v in zip(grasp.coordinates, values, strict=True)}

    def go(self, row: np.ndarray, *, steps: int = 20) -> MotionBuilder:
        """Move to `row` from rest to rest."""
        fraction = np.linspace(0.0, 1.0, steps + 1)[1:, None]
        smooth = fraction**2 * (3.0 - 2.0 * fraction)
        before = self.rows[-1]
        first = len(self.rows) - 1
        self.rows += list(before + smooth * (row - before))
        holds = make_holds(self.held, self.by)
        self.phases.append(PhaseSpan(f"phase {len(self.phases)}", first, len(self.rows) - 1, holds))
        return self

    def wait(self) -> MotionBuilder:
        """Rest for two steps."""
        return self.go(self.rows[-1], steps=2)

    def take(
        self,
        name: str,
        attachment: str = "grip",
        values: Sequence[float] = (0.0, 0.0),
        by: str | None = None,
    ) -> MotionBuilder:
        """Grasp an object with the hand, or with the frame `by`."""
        self.held[name] = attachment
        if by is not None:
            self.by[name] = by
        self._set(name, attachment, values)
        return self

    def let_go(self, *names: str) -> MotionBuilder:
        """Release the named objects, or all."""
        for name in names or tuple(self.held):
            del self.held[name]
            self.by.pop(name, None)
        return self

    def motion(self, *, dt: float = DT, **columns: Sequence[float]) -> Trajectory:
        """Return the motion; `columns` replaces values of grasp coordinates at all waypoints."""
        robot = self.scene.robot.coordinates.names
        shape = len(self.rows)
        extra = [np.full(shape, value) for value in self.values.values()]
        rows = np.column_stack([np.array(self.rows), *extra])
        names = (*robot, *self.values)
        for name, column in columns.items():
            rows[:, names.index(name.replace("__", "."))] = column
        return Trajectory(names, dt * np.arange(shape), rows, tuple(self.phases), len(robot))


def move_base(row: np.ndarray, **values: float) -> np.ndarray:
    """Return `row` with the base moved by `values` of x, y and yaw."""
    out = np.array(row)
    for name, value in values.items():
        out[("x", "y", "yaw").index(name)] += value
    return out


def make_carrying_motion(
    scene: Scene,
    *,
    aside: float = 0.5,
    values: Sequence[float] = (0.0, 0.0),
    off: pin.SE3 | None = None,
) -> MotionBuilder:
    """Take the stick from the table, move it `aside` [m] along y, put it down and retreat.

    `off` displaces the hand from the attachment, in the tool's frame.
    """
    off = pin.SE3.Identity() if off is None else off
    up = solve_reach(compute_grasp_pose(lift(STICK), values=values) * off, _make_guess_above())
    down = solve_reach(compute_grasp_pose(STICK, values=values) * off, up)
    script = MotionBuilder(scene).go(up).go(down).take("stick", values=values).go(up)
    script.go(move_base(up, y=aside)).go(move_base(down, y=aside)).let_go()
    return script.go(move_base(up, y=aside))


def place_object(scene: Scene, name: str, placement: pin.SE3) -> Scene:
    """Return the scene with a free object at `placement`."""
    placed: PlacedObject = dataclasses.replace(scene.objects[name], placement=placement)
    return dataclasses.replace(scene, objects={**scene.objects, name: placed})


def replace_grasp(scene: Scene, name: str, attachment: str, **fields: Any) -> Scene:
    """Return the scene with other fields of an object's attachment."""
    placed = scene.objects[name]
    attachments = {**placed.object.attachments}
    attachments[attachment] = dataclasses.replace(attachments[attachment], **fields)
    placed = dataclasses.replace(
        placed, object=dataclasses.replace(placed.object, attachments=attachments)
    )
    return dataclasses.replace(scene, objects={**scene.objects, name: placed})
