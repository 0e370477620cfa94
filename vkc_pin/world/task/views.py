"""Makes terms that keep a point in the view of a camera of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arguments import check_finite_array, check_instance, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.camera import Camera
from vkc_pin.world.task.terms import ROUNDING, Constraint, Cost, Sight, State

if TYPE_CHECKING:
    from vkc_pin.world.scene.scene import Scene

# [m] by which bounds recede for each metre that the hand is nearer than asked
_SLACK = 20.0

Target = str | Sequence[float] | Floats
"""A point in the world, shape (3,) [m], or the name of an attachment (`door.handle`), of a link of
an object (`door.panel`), or of a frame of the robot (`tool`)."""


def keep_in_view(
    scene: Scene,
    camera: Camera,
    target: Target,
    *,
    name: str | None = None,
    during: Sequence[str] | str | None = None,
    holding: str | None = None,
    margin: float = 1.0,
    nearest: float = 0.05,
    until: float = 0.3,
) -> Constraint:
    """Return the constraint that a camera of the robot sees a point.

    With the point's position p in the camera's axes (x right, y up, −z ahead) and its depth
    d = −p_z, the image has the half width w d and the half height h d there. The point is inside if

        d ≥ nearest,   |p_x| ≤ w d,   |p_y| ≤ h d

    A hand that reaches for the point comes between, or carries its camera past it: nothing is
    demanded while the tool frame is near the point. The program keeps the bounds at waypoints.
    Validation also demands that no link of the robot but the camera's own is between camera and
    point.

    Args:
        scene: The scene in which the term is used.
        camera: The camera.
        target: The point to be seen.
        name: Name in reports. Default: `<camera> sees <target>`.
        during: Names of phases in which it holds; see `Constraint`.
        holding: Object that must be held for it; see `Constraint`.
        margin: Angle that stays free between the point and the border of the image [deg].
        nearest: Least depth of the point [m].
        until: Distance between tool frame and point up to which nothing is demanded [m].

    Raises:
        InputError: An argument is invalid.
        UnknownNameError: The robot lacks the camera's frame, or the scene the target.
    """
    near_hand = check_number(until, "until", "a distance [m]", low=0.0)
    view = _View.of(scene, camera, target)
    largest = camera.fov / 2.0
    free = np.radians(check_number(margin, "margin", "an angle [deg]", low=0.0, high=largest))
    near = check_number(nearest, "nearest", "a depth [m]", low=0.0)
    half_height = np.radians(camera.fov) / 2.0
    half_width = np.arctan(np.tan(half_height) * camera.width / camera.height)
    width = float(np.tan(max(half_width - free, 0.0)))
    height = float(np.tan(half_height - free))

    def compute_excess(state: State) -> Any:
        """Return by how much the point is outside each side of the frustum [m]."""
        x, y, depth = view.project(state)
        sides = [x - width * depth, -x - width * depth, y - height * depth, -y - height * depth]
        slack = _SLACK * ca.fmax(near_hand - view.measure_gap(state), 0.0)
        return ca.vertcat(near - depth, *sides) - slack

    return Constraint(
        name or f"{camera.name} sees {view.label}",
        compute_excess,
        upper=0.0,
        during=during,
        holding=holding,
        sight=view.make_sight(near_hand),
    )


def prefer_in_view(
    scene: Scene,
    camera: Camera,
    target: Target,
    *,
    weight: float = 0.1,
    name: str | None = None,
    during: Sequence[str] | str | None = None,
    holding: str | None = None,
) -> Cost:
    """Return the cost 1 − cos α of the angle α between a camera's axis and a point.

    Args:
        scene: The scene in which the term is used.
        camera: The camera.
        target: The point at which it looks.
        weight: Weight of the sum over the waypoints; see `Cost`.
        name: Name in error messages. Default: `<camera> looks at <target>`.
        during: Names of phases in which it counts; see `Cost`.
        holding: Object that must be held for it; see `Cost`.

    Raises:
        InputError: An argument is invalid.
        UnknownNameError: The robot lacks the camera's frame, or the scene the target.
    """
    view = _View.of(scene, camera, target)

    def compute_cost(state: State) -> Any:
        x, y, depth = view.project(state)
        return 1.0 - depth / ca.sqrt(x**2 + y**2 + depth**2 + ROUNDING)

    return Cost(
        name or f"{camera.name} looks at {view.label}",
        compute_cost,
        weight=weight,
        during=during,
        holding=holding,
    )


def make_sight(scene: Scene, camera: Camera, target: Target, *, until: float = 0.0) -> Sight:
    """Return the line from a camera of the robot to a point; see `Sight`.

    Args:
        scene: The scene.
        camera: The camera.
        target: The point.
        until: Distance between tool frame and point up to which the line does not count [m].

    Raises:
        InputError: An argument is invalid.
        UnknownNameError: The robot lacks the camera's frame, or the scene the target.
    """
    return _View.of(scene, camera, target).make_sight(until)


@dataclass(frozen=True, eq=False)
class _View:
    """A camera of a robot and its target.

    Attributes:
        frame: Frame of the robot on which the camera is mounted.
        placement: Placement of the camera in it; see `Camera.placement`.
        target: Frame of the target; "": the world.
        point: Position of the target in its frame, shape (3,) [m].
        label: The target in reports.
        hand: Tool frame.
    """

    frame: str
    placement: pin.SE3
    target: str
    point: Floats
    label: str
    hand: str

    @classmethod
    def of(cls, scene: Scene, camera: Camera, target: Target) -> Self:
        """Return the view of a target in a scene."""
        check_instance(camera, Camera, "camera")
        frame = camera.find_frame(scene.robot)
        target_frame, point, label = _find_target(scene, target)
        return cls(frame, camera.placement, target_frame, point, label, scene.robot.tool_frame)

    def project(self, state: State) -> tuple[Any, Any, Any]:
        """Return the target in the camera's axes: x to the right, y upwards and depth [m]."""
        rotation = state.rotation(self.frame)
        origin = state.position(self.frame) + rotation @ self.placement.translation
        axes = rotation @ self.placement.rotation
        inside = axes.T @ (self._locate(state) - origin)
        return inside[0], inside[1], -inside[2]

    def measure_gap(self, state: State) -> Any:
        """Return the distance of the target from the tool frame [m]."""
        return ca.norm_2(self._locate(state) - state.position(self.hand))

    def make_sight(self, until: float) -> Sight:
        """Return the line of sight; see `Sight`."""
        u, v, w = self.placement.translation.tolist()
        x, y, z = self.point.tolist()
        return Sight(self.frame, (u, v, w), self.target, (x, y, z), self.hand, until)

    def _locate(self, state: State) -> Any:
        """Return the position of the target in the world, shape (3, 1) [m]."""
        if not self.target:
            return ca.SX(self.point)
        return state.position(self.target) + state.rotation(self.target) @ self.point


def _find_target(scene: Scene, target: Target) -> tuple[str, Floats, str]:
    """Return the frame of a target ("" for the world), its position there [m], and its name."""
    if not isinstance(target, str):
        point = check_finite_array(target, "target")
        if point.shape != (3,):
            expected = "a point, shape (3,) [m], or the name of an attachment, a link or a frame"
            raise InputError("wrong shape", field="target", expected=expected, got=point.shape)
        return "", point, ", ".join(f"{value:g}" for value in point)
    frames = {name: (name, np.zeros(3)) for name in scene.robot.frame_names}
    for name, placed in scene.objects.items():
        for link in placed.object.links:
            frames[f"{name}.{link}"] = (f"{name}.{link}", np.zeros(3))
        # An attachment may have the name of a link.
        for attachment, place in placed.object.attachments.items():
            link_frame = f"{name}.{place.link}"
            frames[f"{name}.{attachment}"] = (link_frame, place.placement.translation.copy())
    if target not in frames:
        raise UnknownNameError("target", target, frames, field="target")
    frame, point = frames[target]
    return frame, point, target
