"""Estimates the joint of an articulated object from poses of the link that a hand moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_list, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.poses import as_placement

JointKind = Literal["revolute", "prismatic"]
_FIXED = "fixed"
_DECISIVE = 10.0
"""Difference of two BIC that counts as very strong evidence (Kass and Raftery, JASA 1995)."""
_LARGEST_RADIUS = 2.0  # [m] of a hinge
_DOUBT = 3.0  # standard deviations up to which a rotation may be there
_FEWEST_POSES = 4
_SHARED = 10  # parameters that all poses share: 6 of the link, 2 of the direction, 2 of the point
# A hinge that turns converges within 20. For a straight motion its axis recedes without end, and
# more evaluations hardly change the sum of squares.
_MAX_EVALUATIONS = 40
_STEP = 1e-6  # of finite differences [m], [rad]


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """A joint that was estimated from poses.

    Attributes:
        kind: "revolute" or "prismatic".
        axis: Unit direction of the axis in the frame of the poses, shape (3,).
        point: Point of the axis nearest to the link [m], shape (3,); for a slide, the link's
            origin in the first pose.
        link: Placement of the link at position 0, which is that of the first pose.
        positions: Joint position of each pose [rad] or [m], shape (N,).
        axis_deviation: Standard deviation of the direction, per component across it [rad].
        point_deviation: Standard deviation of the point, per component across the axis [m]; 0 for
            a slide.
        information: Bayesian information criterion of each kind, "fixed" included: the less, the
            more plausible.
    """

    kind: JointKind
    axis: Floats
    point: Floats
    link: pin.SE3
    positions: Floats
    axis_deviation: float
    point_deviation: float
    information: Mapping[str, float]

    def compute_placement(self, position: float) -> pin.SE3:
        """Return the placement of the link at a joint position [rad] or [m]."""
        rotations, translations = _move_link(
            self.kind, self.axis, self.point, self.link, np.array([position])
        )
        return pin.SE3(rotations[0], translations[0])


def estimate_joint(
    poses: Sequence[pin.SE3 | Sequence[float]],
    *,
    position_noise: float = 0.001,
    rotation_noise: float = 0.005,
) -> JointEstimate:
    """Estimate a hinge or a slide from measured poses of the link that it moves.

    Both kinds are fitted by least squares, and the Bayesian information criterion compares them, as
    in Sturm, Stachniss and Burgard, *A probabilistic framework for learning kinematic
    models of articulated objects*, JAIR 41, 2011. A slide must also be straight enough to exclude a
    hinge of up to 2 m radius, which it resembles after a short motion.

    Args:
        poses: Poses of the link in a fixed frame: placements, or x, y, z [m], roll, pitch, yaw
            [rad].
        position_noise: Standard deviation of a measured position, per axis [m].
        rotation_noise: Standard deviation of a measured rotation, per axis [rad].

    Raises:
        InputError: A pose is invalid, there are less than four, or the link has moved too little
            to tell that it moves, or whether it turns or slides.
    """
    check_number(position_noise, "position_noise", "more than 0", low=0.0, strict=True)
    check_number(rotation_noise, "rotation_noise", "more than 0", low=0.0, strict=True)
    listed: tuple[Any, ...] = check_list(poses, "poses", "a list of poses")
    if len(listed) < _FEWEST_POSES:
        raise InputError(
            "too few poses", field="poses", expected=f"{_FEWEST_POSES} or more", got=len(listed)
        )
    placements = [as_placement(pose, name=f"poses[{k}]") for k, pose in enumerate(listed)]
    data = _Data(placements, position_noise, rotation_noise)
    fits = {kind: _Fit(kind, data) for kind in ("revolute", "prismatic")}
    information = {kind: fit.information for kind, fit in fits.items()}
    information[_FIXED] = _compute_fixed_information(data)
    moving = min(fits, key=lambda kind: information[kind])
    if information[_FIXED] - information[moving] < _DECISIVE:
        raise _make_refusal(data, "it may stay")
    if information["prismatic"] - information["revolute"] >= _DECISIVE:
        return fits["revolute"].make_estimate(information)
    if data.is_straight(fits["prismatic"].positions):
        return fits["prismatic"].make_estimate(information)
    raise _make_refusal(data, "it may turn or slide")


def _make_refusal(data: _Data, doubt: str) -> InputError:
    """Return the error about a motion that is too short to tell the joint."""
    travel, turn = data.measure_motion()
    return InputError(
        "the motion is too short to tell the joint",
        field="poses",
        expected="enough motion to tell whether the link stays, slides or turns",
        got=f"{1e3 * travel:.0f} mm and {np.degrees(turn):.1f}°: {doubt}",
    )


class _Data:
    """Measured poses as arrays.

    Attributes:
        rotations, translations: Shape (N, 3, 3), and (N, 3) [m].
    """

    def __init__(
        self, placements: Sequence[pin.SE3], position_noise: float, rotation_noise: float
    ) -> None:
        self.rotations = np.array([placement.rotation for placement in placements])
        self.translations = np.array([placement.translation for placement in placements])
        self.position_noise = position_noise
        self.rotation_noise = rotation_noise

    @property
    def size(self) -> int:
        """Number of measured values, six for each pose."""
        return 6 * len(self.translations)

    def compute_residuals(self, rotations: Floats, translations: Floats) -> Floats:
        """Return the errors of predicted poses, divided by their deviations, shape (N, 6)."""
        errors = self.translations - translations
        turns = _compute_rotation_vectors(rotations.transpose(0, 2, 1) @ self.rotations)
        return np.hstack([errors / self.position_noise, turns / self.rotation_noise])

    def is_straight(self, travels: Floats) -> bool:
        """Return whether a motion turns less per metre than any hinge of usual size would.

        A hinge of radius r turns by q / r over a travel q. The slope s of the rotations against the
        travels q has the deviation σ / sqrt(Σ (q - mean q)²) in each component.
        """
        turned = _compute_rotation_vectors(self.rotations @ self.rotations[0].T)
        centred = travels - travels.mean()
        spread = float(centred @ centred)
        slope = float(np.linalg.norm(centred @ turned)) / spread
        deviation = self.rotation_noise / np.sqrt(spread)
        return slope + _DOUBT * deviation < 1.0 / _LARGEST_RADIUS

    def measure_motion(self) -> tuple[float, float]:
        """Return the largest displacement [m] and rotation [rad] from the first pose."""
        travel = np.linalg.norm(self.translations - self.translations[0], axis=1)
        turns = _compute_rotation_vectors(self.rotations[0].T @ self.rotations)
        return float(travel.max()), float(np.linalg.norm(turns, axis=1).max())


class _Fit:
    """Least-squares fit of one kind of joint.

    The poses are T_i = exp(ξ q_i) T_0 with q_0 = 0. The parameters are a displacement of T_0 from
    its first guess (6), rotations of the direction across itself (2), displacements of the point
    across the axis (2; none of a slide), and q_1, ..., q_{N-1}.
    """

    def __init__(self, kind: JointKind, data: _Data) -> None:
        from scipy.optimize import least_squares

        self._kind = kind
        self._data = data
        self._link = pin.SE3(data.rotations[0], data.translations[0])
        self._axis, self._point, positions = _guess_joint(kind, data)
        self._across = _find_across(self._axis)
        self._shared = _SHARED if kind == "revolute" else _SHARED - 2
        start = np.concatenate([np.zeros(self._shared), positions[1:]])
        found = least_squares(
            lambda x: self._compute_residuals(x).ravel(),
            start,
            jac=self._compute_jacobian,
            max_nfev=_MAX_EVALUATIONS,
        )
        self._x = found.x
        # With n values and k parameters, BIC = χ² + k log n, up to a constant.
        self.information = 2.0 * float(found.cost) + len(start) * np.log(data.size)

    @property
    def positions(self) -> Floats:
        """Joint position of each pose [rad] or [m], shape (N,)."""
        return self._unpack(self._x)[3]

    def make_estimate(self, information: Mapping[str, float]) -> JointEstimate:
        """Return the estimate, with the deviations that follow from those of the poses.

        The inverse of JᵀJ is the covariance of the parameters, since residuals have deviation 1.
        """
        axis, point, link, positions = self._unpack(self._x)
        jacobian = self._compute_jacobian(self._x)
        covariance = np.linalg.pinv(jacobian.T @ jacobian)
        deviations = np.sqrt(np.diag(covariance)[6 : self._shared])
        is_hinge = self._kind == "revolute"
        if is_hinge:
            # The foot of the perpendicular from the link
            point = point + axis * (axis @ (link.translation - point))
        return JointEstimate(
            self._kind,
            axis,
            point if is_hinge else link.translation.copy(),
            link,
            positions,
            float(deviations[:2].max()),
            float(deviations[2:].max()) if is_hinge else 0.0,
            dict(information),
        )

    def _unpack(self, x: Floats) -> tuple[Floats, Floats, pin.SE3, Floats]:
        """Return axis, point, T_0 and positions of parameters."""
        link = self._link * pin.exp6(x[:6])
        axis = pin.exp3(self._across.T @ x[6:8]) @ self._axis
        point = self._point
        if self._kind == "revolute":
            point = point + self._across.T @ x[8:10]
        return axis, point, link, np.concatenate([[0.0], x[self._shared :]])

    def _compute_residuals(self, x: Floats) -> Floats:
        return self._data.compute_residuals(*_move_link(self._kind, *self._unpack(x)))

    def _compute_jacobian(self, x: Floats) -> Floats:
        """Return the Jacobian of the residuals by central differences, shape (6 N, k).

        Each pose depends on its own position alone, so that one difference yields all of these
        columns.
        """
        count = len(self._data.translations)
        jacobian = np.zeros((count, 6, len(x)))
        for column in range(self._shared):
            jacobian[:, :, column] = self._differentiate(x, np.eye(len(x))[column])
        along = np.zeros(len(x))
        along[self._shared :] = 1.0
        slopes = self._differentiate(x, along)
        for pose in range(1, count):
            jacobian[pose, :, self._shared + pose - 1] = slopes[pose]
        return jacobian.reshape(6 * count, len(x))

    def _differentiate(self, x: Floats, direction: Floats) -> Floats:
        ahead = self._compute_residuals(x + _STEP * direction)
        behind = self._compute_residuals(x - _STEP * direction)
        return (ahead - behind) / (2.0 * _STEP)


def _guess_joint(kind: JointKind, data: _Data) -> tuple[Floats, Floats, Floats]:
    """Return axis, point and positions from which the least squares begin.

    A hinge turns about the direction n of the largest rotation R_k R_0ᵀ. Its axis passes through
    the points c that all motions leave in place: (I - D_i) c = t_i - D_i t_0, D_i = R_i R_0ᵀ.
    """
    origin = data.translations[0]
    if kind == "prismatic":
        moved = data.translations - origin
        axis = np.linalg.svd(moved)[2][0]
        return axis, origin, moved @ axis
    turned = data.rotations @ data.rotations[0].T
    vectors = _compute_rotation_vectors(turned)
    largest = vectors[np.argmax(np.linalg.norm(vectors, axis=1))]
    length = float(np.linalg.norm(largest))
    axis = largest / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    matrix = (np.eye(3) - turned).reshape(-1, 3)
    right = (data.translations - turned @ origin).ravel()
    point = np.linalg.lstsq(matrix, right, rcond=1e-6)[0]
    return axis, point, vectors @ axis


def _move_link(
    kind: JointKind, axis: Floats, point: Floats, link: pin.SE3, positions: Floats
) -> tuple[Floats, Floats]:
    """Return the link's rotations, shape (N, 3, 3), and translations [m], shape (N, 3)."""
    count = len(positions)
    if kind == "prismatic":
        rotations = np.broadcast_to(link.rotation, (count, 3, 3))
        return rotations, link.translation + positions[:, None] * axis
    # Rodrigues: R = I + sin(q) K + (1 - cos(q)) K², with K = [axis]×
    cross = pin.skew(axis)
    sine = np.sin(positions)[:, None, None]
    rest = (1.0 - np.cos(positions))[:, None, None]
    turns = np.eye(3) + sine * cross + rest * (cross @ cross)
    return turns @ link.rotation, point + turns @ (link.translation - point)


def _compute_fixed_information(data: _Data) -> float:
    """Return the BIC of a link that does not move: its mean pose has six parameters."""
    middle = data.rotations[len(data.rotations) // 2]
    vectors = _compute_rotation_vectors(middle.T @ data.rotations)
    rotation = middle @ pin.exp3(vectors.mean(axis=0))
    residuals = data.compute_residuals(
        np.broadcast_to(rotation, data.rotations.shape), data.translations.mean(axis=0)
    )
    return float((residuals**2).sum() + 6.0 * np.log(data.size))


def _find_across(axis: Floats) -> Floats:
    """Return two unit directions across an axis and each other, shape (2, 3)."""
    return np.asarray(np.linalg.svd(axis[None])[2][1:])


def _compute_rotation_vectors(rotations: Floats) -> Floats:
    """Return the rotation vectors of rotations, shapes (N, 3, 3) and (N, 3) [rad]."""
    return np.array([pin.log3(rotation) for rotation in rotations])
