"""Defines holds: which object is grasped, at which attachment, and how it was measured."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arguments import (
    check_array,
    check_finite_array,
    check_instance,
    check_list,
    check_mapping,
    check_text,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.models.articulated_object import Attachment
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import FixedShapes, clamp_to_limits, list_placed_shapes
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes

MAX_POSITION_DEVIATION = 0.02
"""Largest distance of a hand from the attachment that it holds [m], measured or in physics."""
MAX_ANGLE_DEVIATION = 0.2
"""Largest angle between a hand and the attachment that it holds [rad], measured or in physics."""
_DECIMALS = 9  # of a deviation: converting it to a pose and back gives the same numbers
_SLACK = 1e-9  # [m] or [rad] of rounding
_MAX_STARTS = 81  # combinations of lower end, middle and upper end of the freedoms
Solids = Sequence[tuple[coal.CollisionGeometry, pin.SE3]]
"""Shapes with their placements in the world frame."""
_MAX_OVERLAP = 0.01  # [m] of hand and object or floor: larger than opening inaccuracies
_ROUNDING = 2e-4  # [m] of an opening: measured less accurately than it is written
_APPROACH = (0.0, 0.04, 0.08)  # [m] distances before the grasp at which overlaps are checked
MAX_HELD = 50
"""Largest number of objects held at once; each may be held through another."""


def apply_deviation(attachment: Attachment, deviation: Sequence[float]) -> Attachment:
    """Return an attachment with a deviation, see `Hold.deviation`; none if it is empty."""
    if not deviation:
        return attachment
    translation = np.array(deviation[:3])
    rotation = pin.exp3(np.array(deviation[3:]))
    return dataclasses.replace(attachment, deviation=pin.SE3(rotation, translation))


def fit_grasp(
    attachment: Attachment,
    measured: pin.SE3,
    values: Sequence[float] | None,
    field: str,
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return freedoms and deviation of a measured grasp.

    Args:
        attachment: Nominal attachment.
        measured: Measured placement of its frame in the grasping frame.
        values: Values of the freedoms, [m] and [rad]; None: those with the smallest deviation.
        field: Name of the measured pose, for messages.

    Returns:
        Values of the freedoms, and `Hold.deviation`: empty if it is zero.

    Raises:
        InputError: The hand is too far from the attachment.
    """
    values, deviation = measure_deviation(attachment, measured, values)
    found = np.round(deviation, _DECIMALS) + 0.0  # no negative zeros
    check_deviation(found, field)
    return values, tuple(found.tolist()) if found.any() else ()


def measure_deviation(
    attachment: Attachment, measured: pin.SE3, values: Sequence[float] | None = None
) -> tuple[tuple[float, ...], Floats]:
    """Return the freedoms of a grasp, and how far the hand is from the attachment.

    With the placement M of the hand in the attachment's frame, the deviation at the values v is
    (J(v) · offset)⁻¹ · M, see `Attachment`, as translation and rotation vector.

    Args:
        attachment: The attachment.
        measured: Measured placement of its frame in the grasping frame.
        values: Values of the freedoms, [m] and [rad]; None: those with the smallest deviation.

    Returns:
        Values of the freedoms, and x, y, z [m] and rotation vector [rad] of the grasping frame in
        the frame that the attachment demands at these values, shape (6,).
    """
    hand = measured.inverse()

    def compute_deviation(at: Sequence[float] | Floats) -> Floats:
        difference = attachment.motion(at).actInv(hand)
        return np.concatenate([difference.translation, pin.log3(difference.rotation)])

    if values is None:
        values = _fit_freedoms(attachment, compute_deviation)
    return tuple(float(value) for value in values), compute_deviation(values)


def compute_distances(deviation: Sequence[float] | Floats) -> tuple[float, float]:
    """Return distance [m] and angle [rad] of a hand from its attachment; see `Hold.deviation`."""
    position = float(np.linalg.norm(deviation[:3]))
    angle = float(np.linalg.norm(deviation[3:]))
    return position, angle


def is_within_grasp(position: float, angle: float) -> bool:
    """Return whether a hand at a distance [m] and angle [rad] from its attachment can hold it."""
    is_near = position <= MAX_POSITION_DEVIATION + _SLACK
    return is_near and angle <= MAX_ANGLE_DEVIATION + _SLACK


def check_deviation(deviation: Sequence[float] | Floats, field: str) -> None:
    """Check that a hand is near its attachment. Raises `InputError` if it is not."""
    position, angle = compute_distances(deviation)
    if not is_within_grasp(position, angle):
        raise InputError(
            "the hand is too far from the attachment",
            field=field,
            expected=f"within {1e3 * MAX_POSITION_DEVIATION:g} mm and {MAX_ANGLE_DEVIATION:g} rad",
            got=f"{1e3 * position:.1f} mm and {angle:.3f} rad from it",
        )


def _fit_freedoms(
    attachment: Attachment, compute_deviation: Callable[[Floats], Floats]
) -> tuple[float, ...]:
    """Return the values of the freedoms within their limits with the smallest deviation."""
    if not attachment.freedoms:
        return ()
    from scipy.optimize import least_squares

    scale = np.repeat([MAX_POSITION_DEVIATION, MAX_ANGLE_DEVIATION], 3)
    lower, upper = np.array([(one.lower, one.upper) for one in attachment.freedoms]).T
    middle = (lower + upper) / 2.0
    starts = itertools.product(*zip(lower, middle, upper, strict=True))
    fits = [
        least_squares(
            lambda at: compute_deviation(at) / scale,
            np.clip(start, lower, upper),
            bounds=(lower, upper),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        for start in itertools.islice(starts, _MAX_STARTS)
    ]
    best = min(fits, key=lambda fit: float(fit.cost))
    return tuple(best.x.tolist())


@dataclass(frozen=True)
class Hold:
    """An object held at one of its attachments, by the robot's tool or through another held object.

    Holds are equal if object, attachment, grasping frame and deviation are equal, regardless of
    `at`.

    Attributes:
        object: Its name in the scene.
        attachment: Attachment that is grasped.
        by: Hold of the object that it is held through, such as a stick; None: the robot's tool.
        link: Link of that object which replaces the tool frame.
        at: Values of the attachment's freedoms at the start of a scene that has this hold, [m] and
            [rad]; empty elsewhere.
        deviation: Measured pose of the grasping frame, in the frame that is nominal for the
            attachment at `at`: x, y, z [m] and rotation vector [rad]; empty for a nominal grasp.
    """

    object: str
    attachment: str
    by: Hold | None = None
    link: str | None = None
    at: tuple[float, ...] = field(default=(), compare=False)
    deviation: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_text(self.object, "Hold.object", "a name")
        check_text(self.attachment, "Hold.attachment", "a name")
        if self.link is not None:
            check_text(self.link, "Hold.link", "a name")
        if self.by is not None:
            check_instance(self.by, Hold, "Hold.by")
        values = check_array(self.at, "Hold.at", "a list of numbers").ravel()
        object.__setattr__(self, "at", tuple(values.tolist()))
        deviation = check_finite_array(self.deviation, "Hold.deviation").ravel()
        if deviation.size not in (0, 6):
            raise InputError(
                "wrong number of values",
                field="Hold.deviation",
                expected="x, y, z [m] and a rotation vector [rad]",
                got=deviation.size,
            )
        check_deviation(deviation, "Hold.deviation")
        given = tuple(deviation.tolist()) if deviation.any() else ()
        object.__setattr__(self, "deviation", given)

    @property
    def frame(self) -> str | None:
        """Label of the grasping frame, "<object>.<link>"; None: the tool frame."""
        return f"{self.by.object}.{self.link}" if self.by else None

    @property
    def nominal(self) -> Hold:
        """The same hold, and those it depends on, without `at` and `deviation`."""
        by = None if self.by is None else self.by.nominal
        return Hold(self.object, self.attachment, by, self.link)

    def __str__(self) -> str:
        text = f"{self.object}.{self.attachment}"
        return f"{text} by {self.frame}" if self.by else text


class Holds(tuple[Hold, ...]):
    """Holds, each after the one it depends on. `in` takes a hold, or the name of an object."""

    __slots__ = ()

    def __contains__(self, item: object) -> bool:
        if isinstance(item, str):
            return any(hold.object == item for hold in self)
        return super().__contains__(item)


def make_holds(
    held: Mapping[str, str],
    by: Mapping[str, str] | None = None,
    at: Mapping[str, Sequence[float]] | None = None,
    deviation: Mapping[str, Sequence[float]] | None = None,
) -> tuple[Hold, ...]:
    """Return the holds that mappings describe, as in files, each after the one it depends on.

    Args:
        held: Object → attachment.
        by: Object → "<object>.<link>", for objects that the tool itself does not hold.
        at: Object → values of its attachment's freedoms, [m] and [rad].
        deviation: Object → deviation of its grasp, see `Hold`.
    """
    held = check_mapping(held, "held", "object names, each with that of an attachment")
    by = check_mapping({} if by is None else by, "by")
    at = check_mapping({} if at is None else at, "at")
    deviation = check_mapping({} if deviation is None else deviation, "deviation")
    if len(held) > MAX_HELD:
        raise InputError(
            "too many objects are held", field="held", expected=f"at most {MAX_HELD}", got=len(held)
        )
    for field_name, names in (("by", by), ("at", at), ("deviation", deviation)):
        for name in names:
            if name not in held:
                raise UnknownNameError("held object", name, held, field=field_name)
    found: dict[str, Hold] = {}

    def add(name: str, above: tuple[str, ...]) -> Hold:
        """Add the hold of an object after those it depends on; `above` depend on it."""
        if name in above:
            raise InputError(
                "objects hold each other in a cycle", field="by", got=", ".join(sorted(above))
            )
        if name not in found:
            holder = None
            link = None
            if name in by:
                owner, link = _split_frame(by[name])
                if owner not in held:
                    raise UnknownNameError("held object", owner, held, field="by")
                holder = add(owner, (*above, name))
            found[name] = Hold(
                name,
                held[name],
                by=holder,
                link=link,
                at=at.get(name, ()),
                deviation=deviation.get(name, ()),
            )
        return found[name]

    for name in held:
        add(name, ())
    return tuple(found.values())


def _split_frame(frame: Any) -> tuple[str, str]:
    """Return object and link of a label "<object>.<link>"."""
    text = frame if isinstance(frame, str) else ""
    owner, _, link = text.partition(".")
    if not link:
        raise InputError(
            "not a link of an object",
            field="by",
            expected="<object>.<link>, e.g. stick.tip",
            got=format_value(frame),
        )
    return owner, link


def check_hold_order(holds: Iterable[Hold]) -> Holds:
    """Return the holds if each comes after the one it depends on."""
    holds = check_list(holds, "holds", "a list of Hold", Hold)
    for number, hold in enumerate(holds):
        before = holds[:number]
        if hold.by is not None and hold.by not in before:
            raise InputError(
                "it is held through an object that is not held before it",
                field="holds",
                got=str(hold),
            )
    return Holds(holds)


def get_attachment(objects: Mapping[str, PlacedObject], hold: Hold) -> Attachment:
    """Return the attachment of a hold, with the hold's deviation."""
    return apply_deviation(objects[hold.object].object.attachment(hold.attachment), hold.deviation)


def compute_tool_placement(robot: Robot, start: Floats) -> pin.SE3:
    """Return the placement of the tool frame in the world at a configuration, shape (n,)."""
    return compute_frame_placement(robot, start, robot.tool_frame)


def compute_frame_placement(robot: Robot, start: Floats, frame: str) -> pin.SE3:
    """Return the placement of a frame of the robot in the world at a configuration, shape (n,)."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(start))
    return data.oMf[robot.model.getFrameId(frame)].copy()


def measure_grasp(
    objects: Mapping[str, PlacedObject], hold: Hold, tool: Callable[[], pin.SE3]
) -> pin.SE3:
    """Return where an attachment's frame is in the grasping frame, as the objects are placed."""
    grasp = objects[hold.object].object.attachment(hold.attachment)
    hand = _place_grasping_frame(objects, hold, tool)
    return hand.actInv(objects[hold.object].link_placement(grasp.link) * grasp.placement)


def _place_grasping_frame(
    objects: Mapping[str, PlacedObject], hold: Hold, tool: Callable[[], pin.SE3]
) -> pin.SE3:
    """Return the placement of a hold's grasping frame: the tool frame, or a link of an object."""
    if hold.by is None:
        return tool()
    return objects[hold.by.object].link_placement(str(hold.link))


def resolve_holds(
    objects: Mapping[str, PlacedObject],
    holds: Iterable[Hold],
    measured: Mapping[str, pin.SE3] | None = None,
) -> Holds:
    """Return holds checked against the objects, with values for all freedoms.

    Args:
        objects: Name → object.
        holds: Holds, each after the one it depends on.
        measured: Object → measured placement of the attachment's frame in the grasping frame.
            Freedoms without given values are those nearest to it, otherwise 0.
    """
    measured = {} if measured is None else measured
    found: dict[Hold, Hold] = {}
    for hold in check_hold_order(holds):
        if hold.object not in objects:
            raise UnknownNameError("object", hold.object, objects, field="held")
        attachment = objects[hold.object].object.attachment(hold.attachment)
        freedoms = attachment.freedoms
        where = f"held.{hold.object}.at"
        values = hold.at or (0.0,) * len(freedoms)
        deviation = hold.deviation
        if len(values) != len(freedoms):
            raise InputError(
                "wrong number of values",
                field=where,
                expected=f"{len(freedoms)}, one per freedom",
                got=len(values),
            )
        for value, freedom in zip(values, freedoms, strict=True):
            clamp_to_limits(value, freedom.lower, freedom.upper, where)
        if hold.object in measured:
            values, deviation = fit_grasp(
                attachment,
                measured[hold.object],
                hold.at or None,
                f"held.{hold.object}.measured",
            )
        if deviation and attachment.contact == "push":
            raise InputError(
                "a hand that pushes only touches, so that its grasp cannot deviate",
                field=f"held.{hold.object}.measured",
                expected="an attachment that is grasped",
                got=attachment.name,
            )
        if hold.by is not None:
            holder = objects[hold.by.object]
            holder.link_placement(str(hold.link))  # raises an error if there is no such link
            if not (objects[hold.object].object.free and holder.object.free):
                problem = (
                    "only a free object can be held through another, and only through a free one"
                )
                raise InputError(problem, field=f"held.{hold.object}.by", got=hold.frame)
        by = None if hold.by is None else found[hold.by]
        found[hold] = dataclasses.replace(hold, at=values, by=by, deviation=deviation)
    return Holds(found.values())


def place_held_objects(
    objects: Mapping[str, PlacedObject], tool: Callable[[], pin.SE3], holds: Iterable[Hold]
) -> Mapping[str, PlacedObject]:
    """Return the objects with every free held object at its placement in the hand."""
    placed = dict(objects)
    for hold in holds:
        item = placed[hold.object]
        if not item.object.free:
            continue
        grasp = get_attachment(objects, hold)
        in_object = item.object.link_placement(grasp.link, item.state) * grasp.tool(hold.at)
        hand = _place_grasping_frame(placed, hold, tool)
        placed[hold.object] = dataclasses.replace(item, placement=hand * in_object.inverse())
    return freeze(placed)


def find_reversed_approaches(
    objects: Mapping[str, PlacedObject], holds: Iterable[Hold], robot: Robot, floor: Solids
) -> list[Hold]:
    """Return the holds whose approach overlaps the object or the floor, unless reversed."""
    found = list[Hold]()
    hands = dict[float | None, Solids]()  # by opening
    obstacles = dict[str, FixedShapes]()  # by object
    for hold in holds:
        placed = objects[hold.object]
        opening = robot.opening(placed.object.attachment(hold.attachment).opening)
        if opening not in hands:
            hands[opening] = _find_hand_shapes(robot.opened(opening))
        hand = hands[opening]
        if hold.by is not None and hold.link is not None:
            holder = objects[hold.by.object]
            back = holder.link_placement(hold.link).inverse()
            shapes = list_placed_shapes(make_world_shapes(holder))
            hand = [(shape, back * where) for shape, where in shapes]
        if hold.attachment in placed.reversed:
            continue
        if hold.object not in obstacles:
            own = list_placed_shapes(make_world_shapes(placed))
            obstacles[hold.object] = FixedShapes([*own, *floor])
        solids = obstacles[hold.object]
        if _is_approach_free(placed, hold.attachment, hand, solids):
            continue
        turned = placed.with_reversed(hold.attachment)
        if _is_approach_free(turned, hold.attachment, hand, solids):
            found.append(hold)
    return found


def warn_of_openings(
    objects: Mapping[str, PlacedObject], robot: Robot, start: float | None, where: str
) -> None:
    """Warn of openings out of the gripper's range, which are clamped to it."""
    requested = {} if start is None else {"the start": start}
    for name, placed in objects.items():
        for attachment in placed.object.attachments.values():
            if attachment.opening is not None:
                requested[f"{name}.{attachment.name}"] = attachment.opening
    gripper = robot.gripper
    if gripper is None:
        if requested:
            openings = ", ".join(f"{what} {1e3 * size:g} mm" for what, size in requested.items())
            text = f"the gripper of '{robot.name}' cannot open as requested ({openings})"
            hint = "it keeps its rest configuration; describe `gripper` in its robot.yaml"
            warnings.warn(f"{where}: {text}: {hint}", stacklevel=4)
        return
    for what, opening in requested.items():
        nearest = gripper.clamp_opening(opening)
        if abs(nearest - opening) <= _ROUNDING:
            continue
        text = f"the gripper of '{robot.name}' opens from {1e3 * gripper.min_opening:.1f} to "
        text += f"{1e3 * gripper.max_opening:.1f} mm, not {1e3 * opening:g} mm as requested for "
        text += f"{what}: it opens to {1e3 * nearest:.1f} mm"
        warnings.warn(f"{where}: {text}", stacklevel=4)


def _is_approach_free(
    placed: PlacedObject, attachment: str, hand: Solids, solids: FixedShapes
) -> bool:
    """Return whether the hand approaches an attachment without overlapping solids.

    `hand` is given in the tool frame.
    """
    grasp = placed.object.attachment(attachment)
    where = placed.link_placement(grasp.link)
    choices = [{freedom.lower, 0.0, freedom.upper} for freedom in grasp.freedoms]
    for values in itertools.product(*choices):
        tool = where * grasp.tool(values)
        swept = list[tuple[coal.CollisionGeometry, pin.SE3]]()
        for back in _APPROACH:
            at = tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, -back]))
            swept += [(shape, at * local) for shape, local in hand]
        if solids.compute_clearance(swept, reach=-_MAX_OVERLAP) >= -_MAX_OVERLAP:
            return True
    return False


def _find_hand_shapes(robot: Robot) -> Solids:
    """Return the shapes of a robot's touch links in its tool frame, with all joints at home."""
    data = robot.model.createData()
    shapes = robot.collision.createData()
    q = robot.coordinates.q(np.concatenate([np.zeros(3), robot.home]))
    pin.updateGeometryPlacements(robot.model, data, robot.collision, shapes, q)
    pin.updateFramePlacements(robot.model, data)
    back = data.oMf[robot.model.getFrameId(robot.tool_frame)].inverse()
    found = list[tuple[coal.CollisionGeometry, pin.SE3]]()
    for index, item in enumerate(robot.collision.geometryObjects):
        if robot.link_of(index) in robot.touch_links:
            found.append((item.geometry, back * shapes.oMg[index]))
    return found
