"""Places joints of objects on the axes that were estimated for them."""

from __future__ import annotations

import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.measured_joint import MeasuredJoint, compute_axis
from vkc_pin.world.scene.joint_estimation import JointEstimate, JointKind
from vkc_pin.world.scene.placed_object import PlacedObject


def place_on_estimate(
    placed: PlacedObject,
    joint: str,
    estimate: JointEstimate,
    link: str | None,
    value: float | None,
) -> PlacedObject:
    """Return an object with a joint on an estimated axis; see `Scene.with_measured_joint`.

    In the world, a joint with the placement P moves its link by M(v), so that the link is at
    B = P · M(v) · X. At the measured value v, B is known. That leaves a displacement of the joint's
    frame: the described one, displaced with the link, is turned by the least rotation on the
    direction of the axis, and moved to the nearest point of it. X follows.
    """
    index = placed.find_joint(joint)
    item = placed.object
    _check_kind(placed, joint, estimate)
    state = placed.state.copy()
    if value is not None:
        state[item.coordinates.index(joint)] = check_number(value, "value")
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(state))
    parent_index = int(item.model.parents[index])
    parent = placed.placement * data.oMi[parent_index]
    body = placed.placement * data.oMi[index]
    motion = (parent * item.model.jointPlacements[index]).actInv(body)
    if link is None:
        measured_body = estimate.link * placed.get_link_shift(index).inverse()
    else:
        measured_body = _place_body(placed, index, link, data, estimate.link)

    displaced = measured_body * motion.inverse()
    axis = displaced.rotation @ compute_axis(item.model, index)
    target = estimate.align(axis).axis
    turn = pin.Quaternion.FromTwoVectors(axis, target).matrix()
    origin = displaced.translation
    if estimate.kind == "revolute":
        origin = estimate.point + target * (target @ (origin - estimate.point))
    new = pin.SE3(turn @ displaced.rotation, origin)

    parent_link = parent * placed.get_link_shift(parent_index)
    own_link = measured_body * placed.get_link_shift(index)
    measured = MeasuredJoint(parent_link.actInv(new), (new * motion).actInv(own_link))
    return placed.with_measured_joint(joint, measured)


def find_axis(placed: PlacedObject, joint: str) -> tuple[JointKind, Floats, Floats]:
    """Return kind, direction and a point of a joint's axis in the world, shape (3,) each.

    Raises:
        UnknownNameError: The object has no such joint.
    """
    index = placed.find_joint(joint)
    item = placed.object
    slides = item.coordinates.units[item.coordinates.index(joint)] == "m"
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(placed.state))
    frame = placed.placement * data.oMi[index]
    kind: JointKind = "prismatic" if slides else "revolute"
    return kind, frame.rotation @ compute_axis(item.model, index), frame.translation


def _check_kind(placed: PlacedObject, joint: str, estimate: JointEstimate) -> None:
    """Check that an estimate is one of this kind of joint, and that the object is fixed."""
    if placed.object.free:
        raise InputError(
            "joints are measured of objects that are fixed in the world",
            field="name",
            expected="an object that is not free",
            got=placed.name,
        )
    kind, _, _ = find_axis(placed, joint)
    if estimate.kind != kind:
        raise InputError(
            "an estimate of another kind of joint",
            field="estimate",
            expected=f"{kind}, as {placed.name}.{joint} is described",
            got=estimate.kind,
        )


def _place_body(
    placed: PlacedObject, joint: int, link: str, data: pin.Data, pose: pin.SE3
) -> pin.SE3:
    """Return the placement of a joint's body in the world if a link that it carries is at a pose.

    `data` has the placements of all joints. Raises `InputError`.
    """
    model = placed.object.model
    frame = model.frames[placed.object.link_frame(link)]
    if joint not in list(model.supports[frame.parentJoint]):
        raise InputError(
            "a link that the joint does not move",
            field="link",
            expected=f"a link behind {placed.name}.{model.names[joint]}",
            got=link,
        )
    in_body = data.oMi[joint].actInv(data.oMi[frame.parentJoint] * frame.placement)
    return pose * in_body.inverse()
