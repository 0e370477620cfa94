"""Estimates the joint of an articulated object from poses of the link that a hand moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_list, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.poses import as_placement

JointKind = Literal["revolute", "prismatic"]
_FIXED = "fixed"
DECISIVE = 10.0
"""Difference of two BIC that counts as very strong evidence (Kass and Raftery, JASA 1995)."""
_LARGEST_RADIUS = 2.0  # [m] of a hinge
_DOUBT = 3.0  # standard deviations up to which a rotation may be there, or errors may be noise
FEWEST_POSES = 4
"""Fewest poses that tell a joint."""
# parameters that all poses share: placement of the link; direction and point of the axis
_LINK_PARAMETERS = 6
_HINGE_PARAMETERS = 4
_SLIDE_PARAMETERS = 2
# A hinge that turns converges within ten steps. For a straight motion its axis recedes without end,
# and more steps hardly change the sum of squares.
_MAX_STEPS = 20
_FIRST_DAMPING = 1e-3  # relative to the diagonal of the normal equations, as Marquardt begins
_DAMPING_FACTOR = 10.0
_LARGEST_DAMPING = 1e6
_FLOOR = 1e-12  # of that diagonal: a point does not matter if nothing turns
_TOLERANCE = 1e-6  # of χ², relative and absolute: far less than DECISIVE
_SMALL = 1e-9  # sine of a rotation below which the rotation vector is that of first order
_HALF_TURN = -0.9  # cosine of a rotation below which its sine does not tell the axis well


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
        joint = _Joint(self.axis, self.point, self.link, np.array([position]))
        rotations, translations = joint.place(self.kind)
        return pin.SE3(rotations[0], translations[0])

    def align(self, axis: Floats) -> JointEstimate:
        """Return the estimate with the direction of its axis nearer to another, shape (3,).

        A line has two directions; the other one reverses the positions.
        """
        if self.axis @ axis >= 0.0:
            return self
        return replace(self, axis=-self.axis, positions=-self.positions)


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
    data = _make_data(poses, position_noise, rotation_noise)
    fits = {kind: _Fit(kind, data) for kind in ("revolute", "prismatic")}
    information = {kind: fit.information for kind, fit in fits.items()}
    information[_FIXED] = _compute_fixed_information(data)
    moving = min(fits, key=lambda kind: information[kind])
    if information[_FIXED] - information[moving] < DECISIVE:
        raise _make_refusal(data, "it may stay")
    if information["prismatic"] - information["revolute"] >= DECISIVE:
        return fits["revolute"].make_estimate(information)
    if data.is_straight(fits["prismatic"].positions):
        return fits["prismatic"].make_estimate(information)
    raise _make_refusal(data, "it may turn or slide")


@dataclass(frozen=True)
class JointFit:
    """How well a kind of joint explains poses.

    Attributes:
        information: Bayesian information criterion.
        misfit: (χ² - ν) / sqrt(2 ν) with ν degrees of freedom: by how many standard deviations the
            errors are larger than noise.
    """

    information: float
    misfit: float

    @property
    def is_plausible(self) -> bool:
        """Whether the errors may be noise."""
        return self.misfit <= _DOUBT


def fit_joint(
    poses: Sequence[pin.SE3 | Sequence[float]],
    kind: JointKind,
    known: tuple[Floats, Floats] | None = None,
    *,
    position_noise: float = 0.001,
    rotation_noise: float = 0.005,
) -> JointFit:
    """Fit one kind of joint to poses.

    If the information of a known axis exceeds that of any axis by `DECISIVE`, the axis is very
    probably elsewhere.

    Args:
        poses: See `estimate_joint`.
        kind: Kind of the joint.
        known: Unit direction of its axis in the frame of the poses, shape (3,), and a point of it,
            shape (3,) [m]. Default: those that fit best.
        position_noise: See `estimate_joint`.
        rotation_noise: See `estimate_joint`.

    Raises:
        InputError: A pose is invalid, or there are less than four.
    """
    data = _make_data(poses, position_noise, rotation_noise)
    fit = _Fit(kind, data, known)
    return JointFit(fit.information, fit.misfit)


def _make_data(
    poses: Sequence[pin.SE3 | Sequence[float]], position_noise: float, rotation_noise: float
) -> _Data:
    """Return checked poses. Raises `InputError`."""
    check_number(position_noise, "position_noise", "more than 0", low=0.0, strict=True)
    check_number(rotation_noise, "rotation_noise", "more than 0", low=0.0, strict=True)
    listed: tuple[Any, ...] = check_list(poses, "poses", "a list of poses")
    if len(listed) < FEWEST_POSES:
        raise InputError(
            "too few poses", field="poses", expected=f"{FEWEST_POSES} or more", got=len(listed)
        )
    placements = [
        pose if isinstance(pose, pin.SE3) else as_placement(pose, name=f"poses[{k}]")
        for k, pose in enumerate(listed)
    ]
    data = _Data(placements, position_noise, rotation_noise)
    if not (np.isfinite(data.rotations).all() and np.isfinite(data.translations).all()):
        for k, pose in enumerate(placements):
            as_placement(pose, name=f"poses[{k}]")  # names the first invalid one
    return data


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
        """Return the errors of predicted poses, divided by their deviations, shape (..., N, 6)."""
        errors = self.translations - translations
        turns = _compute_rotation_vectors(rotations.swapaxes(-1, -2) @ self.rotations)
        return np.concatenate([errors / self.position_noise, turns / self.rotation_noise], axis=-1)

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
    """Least-squares fit of one kind of joint by Levenberg and Marquardt's method.

    The poses are T_i = exp(ξ q_i) T_0 with q_0 = 0. All poses share the placement T_0 (6
    parameters), and unless they are known, the direction of the axis (2) and its point (2; none of
    a slide). Each of q_1, ..., q_{N-1} matters to one pose alone, so that it is eliminated from the
    linear equations of a step.

    Args:
        kind: Kind of joint.
        data: The poses.
        known: Axis and point, if they are known.
    """

    def __init__(
        self, kind: JointKind, data: _Data, known: tuple[Floats, Floats] | None = None
    ) -> None:
        self._kind = kind
        self._data = data
        free = _SLIDE_PARAMETERS if kind == "prismatic" else _HINGE_PARAMETERS
        self._size = _LINK_PARAMETERS + (free if known is None else 0)
        axis, point = _guess_axis(kind, data) if known is None else known
        link = pin.SE3(data.rotations[0], data.translations[0])
        positions = _guess_positions(kind, data, axis)
        self._joint = _Joint(axis, point, link, positions)
        self._minimize()
        # With n values and k parameters, BIC = χ² + k log n, up to a constant.
        count = self._size + len(positions) - 1
        cost = self._compute_cost(self._joint)
        self.information = cost + count * np.log(data.size)
        freedoms = data.size - count
        self.misfit = float((cost - freedoms) / np.sqrt(2.0 * freedoms))

    @property
    def positions(self) -> Floats:
        """Joint position of each pose [rad] or [m], shape (N,)."""
        return self._joint.positions

    def make_estimate(self, information: Mapping[str, float]) -> JointEstimate:
        """Return the estimate, with the deviations that follow from those of the poses.

        The inverse of JᵀJ is the covariance of the parameters, since residuals have deviation 1.
        """
        axis, link = self._joint.axis, self._joint.link
        _, jacobian, _, _ = self._linearize()
        covariance = np.linalg.pinv(jacobian.T @ jacobian)
        deviations = np.sqrt(np.diag(covariance)[_LINK_PARAMETERS:])
        is_hinge = self._kind == "revolute"
        point = link.translation.copy()
        if is_hinge:
            # The foot of the perpendicular from the link
            point = self._joint.point
            point = point + axis * (axis @ (link.translation - point))
        return JointEstimate(
            self._kind,
            axis,
            point,
            link,
            self.positions,
            float(deviations[:2].max()),
            float(deviations[2:].max()) if is_hinge else 0.0,
            dict(information),
        )

    def _minimize(self) -> None:
        cost = self._compute_cost(self._joint)
        damping = _FIRST_DAMPING
        for _ in range(_MAX_STEPS):
            residuals, jacobian, slopes, along = self._linearize()
            normal = jacobian.T @ jacobian
            right = -jacobian.T @ residuals.ravel()
            while True:
                damped = normal + damping * np.diag(np.diag(normal) + _FLOOR)
                step = np.asarray(np.linalg.solve(damped, right), float)
                turns = -(np.sum(slopes * residuals, axis=1) + along @ step)
                changed = self._displace(step, turns)
                new_cost = self._compute_cost(changed)
                if new_cost <= cost or damping > _LARGEST_DAMPING:
                    break
                damping *= _DAMPING_FACTOR
            if new_cost > cost:
                return
            decrease = cost - new_cost
            self._joint, cost = changed, new_cost
            damping /= _DAMPING_FACTOR
            if decrease <= _TOLERANCE * cost + _TOLERANCE:
                return

    def _compute_cost(self, joint: _Joint) -> float:
        """Return χ², the sum of squares of the residuals."""
        residuals = self._data.compute_residuals(*joint.place(self._kind))
        return float(np.sum(residuals**2))

    def _displace(self, step: Floats, changes: Floats) -> _Joint:
        """Return the joint after a step of the parameters, shape (S,), and of positions, (N,)."""
        axis, point = self._joint.axis, self._joint.point
        if self._size > _LINK_PARAMETERS:
            across = _find_across(axis)
            axis = pin.exp3(across.T @ step[6:8]) @ axis
            point = point + across[: self._size - 8].T @ step[8:]
        link = self._joint.link * pin.exp6(step[:6])
        return _Joint(axis, point, link, self._joint.positions + changes)

    def _linearize(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the linear equations of a step, from which the positions are eliminated.

        Let D_i = exp(ξ q_i), a pose [R, t] and small rotations w of D_i. Then t changes by
        w × (t - c), and R by Rᵀ w in its own frame. A position changes w by the direction n of the
        axis, a rotation d of n by (I - D_i) d. A displacement of the point changes t by (I - D_i)
        times it. With the derivatives J of a pose by the parameters and g by its position, the best
        position leaves the residuals (I - ĝ ĝᵀ)(r + J x), ĝ = g / |g|.

        Returns:
            Residuals r, shape (N, 6); their Jacobian without positions, shape (6 N, S); g / |g|²,
            shape (N, 6), and gᵀJ / |g|², shape (N, S).
        """
        joint = self._joint
        rotations, translations = joint.place(self._kind)
        residuals = self._data.compute_residuals(rotations, translations)
        count = len(translations)
        moves = np.zeros((count, 3, self._size))  # of t by the parameters
        turns = np.zeros((count, 3, self._size))  # of R in its own frame
        displacements = rotations @ joint.link.rotation.T
        moves[:, :, :3] = rotations
        turns[:, :, 3:6] = np.eye(3)
        own = rotations.swapaxes(1, 2)
        across = _find_across(joint.axis)
        if self._kind == "prismatic":
            slope = np.broadcast_to(joint.axis, (count, 3))
            slope_turns = np.zeros((count, 3))
            if self._size > _LINK_PARAMETERS:
                moves[:, :, 6:8] = joint.positions[:, None, None] * np.cross(across, joint.axis).T
        else:
            arms = translations - joint.point
            slope = np.cross(joint.axis, arms)
            slope_turns = own @ joint.axis
            if self._size > _LINK_PARAMETERS:
                left = (np.eye(3) - displacements) @ across.T
                moves[:, :, 6:8] = np.cross(left, arms[:, :, None], axis=1)
                turns[:, :, 6:8] = own @ left
                moves[:, :, 8:10] = left
        # Residuals are measured minus predicted.
        noises = self._data.position_noise, self._data.rotation_noise
        derivatives = -np.concatenate([moves / noises[0], turns / noises[1]], axis=1)
        slopes = -np.concatenate([slope / noises[0], slope_turns / noises[1]], axis=1)
        inverse = slopes / np.sum(slopes**2, axis=1, keepdims=True)
        inverse[0] = 0.0  # the first position is 0
        along = np.einsum("ni,nij->nj", inverse, derivatives)
        jacobian = derivatives - slopes[:, :, None] * along[:, None, :]
        return residuals, jacobian.reshape(6 * count, self._size), inverse, along


def _guess_axis(kind: JointKind, data: _Data) -> tuple[Floats, Floats]:
    """Return axis and point from which the least squares begin.

    A hinge turns about the direction n of the largest rotation R_k R_0ᵀ. Its axis passes through
    the points c that all motions leave in place: (I - D_i) c = t_i - D_i t_0, D_i = R_i R_0ᵀ.
    """
    origin = data.translations[0]
    if kind == "prismatic":
        return np.linalg.svd(data.translations - origin)[2][0], origin
    turned = data.rotations @ data.rotations[0].T
    vectors = _compute_rotation_vectors(turned)
    largest = vectors[np.argmax(np.linalg.norm(vectors, axis=1))]
    length = float(np.linalg.norm(largest))
    axis = largest / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    matrix = (np.eye(3) - turned).reshape(-1, 3)
    right = (data.translations - turned @ origin).ravel()
    point = np.linalg.lstsq(matrix, right, rcond=1e-6)[0]
    return axis, point


def _guess_positions(kind: JointKind, data: _Data, axis: Floats) -> Floats:
    """Return the travel or rotation of each pose along an axis, shape (N,)."""
    if kind == "prismatic":
        return np.asarray((data.translations - data.translations[0]) @ axis)
    turned = data.rotations @ data.rotations[0].T
    return np.asarray(_compute_rotation_vectors(turned) @ axis)


@dataclass(frozen=True, eq=False)
class _Joint:
    """A joint and the positions of poses.

    Attributes:
        axis: Direction of its axis, shape (3,).
        point: A point of its axis, shape (3,) [m].
        link: Placement of the link at position 0.
        positions: Positions, shape (N,) [rad] or [m].
    """

    axis: Floats
    point: Floats
    link: pin.SE3
    positions: Floats

    def place(self, kind: JointKind) -> tuple[Floats, Floats]:
        """Return the link's rotations, shape (N, 3, 3), and translations [m], shape (N, 3)."""
        count = len(self.positions)
        start = self.link
        if kind == "prismatic":
            rotations = np.broadcast_to(start.rotation, (count, 3, 3))
            return rotations, start.translation + self.positions[:, None] * self.axis
        # Rodrigues: R = I + sin(q) K + (1 - cos(q)) K², with K = [axis]×
        cross = pin.skew(self.axis)
        sine = np.sin(self.positions)[:, None, None]
        rest = (1.0 - np.cos(self.positions))[:, None, None]
        turns = np.eye(3) + sine * cross + rest * (cross @ cross)
        return turns @ start.rotation, self.point + turns @ (start.translation - self.point)


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
    """Return the rotation vectors of rotations, shapes (..., 3, 3) and (..., 3) [rad].

    R - Rᵀ = 2 sin(θ) [n]×, and the trace of R is 1 + 2 cos(θ). Calls of `pin.log3`, one a rotation,
    would take most of the time of an estimate.
    """
    odd = 0.5 * (rotations - rotations.swapaxes(-1, -2))
    vectors = np.stack([odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]], axis=-1)
    sines = np.sqrt(np.sum(vectors**2, axis=-1))
    cosines = 0.5 * (np.trace(rotations, axis1=-2, axis2=-1) - 1.0)
    is_turned = sines > _SMALL
    # The rotation vector is the odd part to first order where it is not turned.
    scale = np.arctan2(sines, cosines) / np.where(is_turned, sines, 1.0)
    vectors *= np.where(is_turned, scale, 1.0)[..., None]
    for index in np.argwhere(cosines < _HALF_TURN):
        vectors[tuple(index)] = pin.log3(rotations[tuple(index)])
    return vectors
