"""The shortest paths of a car that drives ahead and back, in closed form.

J. A. Reeds and L. A. Shepp, Optimal paths for a car that goes both forwards and backwards, Pacific Journal of Mathematics 145
(2), 1990: they are among 48 words of at most five pieces, arcs of the least radius and straight lines. A formula each gives the
pieces of some (8.1 to 8.4 and 8.7 to 8.11 there); going backwards in time, mirroring and reversing give the rest. Here poses
are those of the goal as the start sees it, lengths are in units of the radius, and all formulas work on batches.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vkc_pin.arrays import Bools, Floats

__all__ = ["lengths_of", "shortest_words"]

_HALF = np.pi / 2
_SAME = 1e-9

_Pieces = tuple[Floats, ...]


def _mod(angle: Floats) -> Floats:
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def _polar(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    return np.hypot(x, y), np.arctan2(y, x)


def _lsl(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    u, t = _polar(x - np.sin(phi), y - 1.0 + np.cos(phi))
    return _only((t >= -_SAME) & (_mod(phi - t) >= -_SAME), t, u, _mod(phi - t))


def _lsr(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    far, angle = _polar(x + np.sin(phi), y - 1.0 - np.cos(phi))
    u = np.sqrt(np.maximum(far**2 - 4.0, 0.0))
    t = _mod(angle + np.arctan2(2.0, u))
    v = _mod(t - phi)
    return _only((far >= 2.0) & (t >= -_SAME) & (v >= -_SAME), t, u, v)


def _lrl(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    far, angle = _polar(x - np.sin(phi), y - 1.0 + np.cos(phi))
    u = -2.0 * np.arcsin(np.minimum(far / 4.0, 1.0))
    t = _mod(angle + u / 2 + np.pi)
    v = _mod(phi - t + u)
    return _only((far <= 4.0) & (t >= -_SAME) & (u <= _SAME), t, u, v)


def _tau_omega(u: Floats, v: Floats, xi: Floats, eta: Floats, phi: Floats) -> tuple[Floats, Floats]:
    delta = _mod(u - v)
    a, b = np.sin(u) - np.sin(delta), np.cos(u) - np.cos(delta) - 1.0
    t = np.arctan2(eta * a - xi * b, xi * a + eta * b)
    tau = _mod(np.where(2.0 * (np.cos(delta) - np.cos(v) - np.cos(u)) + 3.0 < 0.0, t + np.pi, t))
    return tau, _mod(tau - u + v - phi)


def _lrlr_between(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    """L+ R+ L- R-, both middle arcs alike."""
    xi, eta = x + np.sin(phi), y - 1.0 - np.cos(phi)
    rho = (2.0 + np.hypot(xi, eta)) / 4.0
    u = np.arccos(np.clip(rho, -1.0, 1.0))
    t, v = _tau_omega(u, -u, xi, eta, phi)
    return _only((rho <= 1.0) & (t >= -_SAME) & (v <= _SAME), t, u, -u, v)


def _lrlr_within(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    """L+ R- L- R+, both middle arcs alike."""
    xi, eta = x + np.sin(phi), y - 1.0 - np.cos(phi)
    rho = (20.0 - xi**2 - eta**2) / 16.0
    u = -np.arccos(np.clip(rho, -1.0, 1.0))
    t, v = _tau_omega(u, u, xi, eta, phi)
    return _only((rho >= 0.0) & (rho <= 1.0) & (u >= -_HALF) & (t >= -_SAME) & (v >= -_SAME), t, u, u, v)


def _lrsl(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    far, angle = _polar(x - np.sin(phi), y - 1.0 + np.cos(phi))
    root = np.sqrt(np.maximum(far**2 - 4.0, 0.0))
    u = 2.0 - root
    t = _mod(angle + np.arctan2(root, -2.0))
    v = _mod(phi - _HALF - t)
    return _only((far >= 2.0) & (t >= -_SAME) & (u <= _SAME) & (v <= _SAME), t, np.full_like(t, -_HALF), u, v)


def _lrsr(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    far, t = _polar(-(y - 1.0 - np.cos(phi)), x + np.sin(phi))
    u, v = 2.0 - far, _mod(t + _HALF - phi)
    return _only((far >= 2.0) & (t >= -_SAME) & (u <= _SAME) & (v <= _SAME), t, np.full_like(t, -_HALF), u, v)


def _lrslr(x: Floats, y: Floats, phi: Floats) -> _Pieces:
    xi, eta = x + np.sin(phi), y - 1.0 - np.cos(phi)
    far = np.hypot(xi, eta)
    u = 4.0 - np.sqrt(np.maximum(far**2 - 4.0, 0.0))
    t = _mod(np.arctan2((4.0 - u) * xi - 2.0 * eta, -2.0 * xi + (u - 4.0) * eta))
    v = _mod(t - phi)
    quarter = np.full_like(t, -_HALF)
    return _only((far >= 2.0) & (u <= _SAME) & (t >= -_SAME) & (v >= -_SAME), t, quarter, u, quarter, v)


def _only(right: Bools, *pieces: Floats) -> _Pieces:
    return tuple(np.where(right, piece, np.inf) for piece in pieces)


# Each formula with the way its pieces turn, left 1, right -1, and whether it is a word of its own when reversed.
_FORMULAS: tuple[tuple[Callable[..., _Pieces], tuple[int, ...], bool], ...] = (
    (_lsl, (1, 0, 1), False),
    (_lsr, (1, 0, -1), False),
    (_lrl, (1, -1, 1), True),
    (_lrlr_between, (1, -1, 1, -1), False),
    (_lrlr_within, (1, -1, 1, -1), False),
    (_lrsl, (1, -1, 0, 1), True),
    (_lrsr, (1, -1, 0, -1), True),
    (_lrslr, (1, -1, 0, 1, -1), False),
)


def _words(goals: Floats) -> list[tuple[Floats, tuple[int, ...]]]:
    """Return all words to goals, (B, 3): the lengths of their pieces, back < 0, shape (pieces, B), and which way these turn.

    Pieces of a word that does not lead to a goal are infinite.
    """
    x, y, phi = goals.T
    back = x * np.cos(phi) + y * np.sin(phi), x * np.sin(phi) - y * np.cos(phi)  # the start as the goal sees it, mirrored
    found = []
    for formula, turns, reverses in _FORMULAS:
        for reverse in (False, True) if reverses else (False,):
            for flip in (1, -1):  # backwards in time
                for mirror in (1, -1):
                    px, py = back if reverse else (x, y)
                    pieces = np.array(formula(flip * px, mirror * py, flip * mirror * phi)) * flip
                    ways = tuple(mirror * turn for turn in turns)
                    found.append((pieces[::-1], ways[::-1]) if reverse else (pieces, ways))
    return found


def lengths_of(goals: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return how far the shortest paths lead [m], and how far they turn [rad], shape (B,) each.

    Args:
        goals: As the start sees them, in units of the radius, shape (B, 3).
        radius: [m].
    """
    words = _words(goals)
    lengths = np.array([np.abs(pieces).sum(axis=0) for pieces, _ in words])
    turns = np.array([np.abs(pieces[np.array(ways) != 0]).sum(axis=0) for pieces, ways in words])
    best = np.argmin(lengths, axis=0), np.arange(len(goals))
    return radius * lengths[best], turns[best]


def shortest_words(goal: Floats, radius: float) -> list[tuple[float, float]]:
    """Return the pieces of the shortest path to a goal, shape (3,): lengths [m, back < 0] and turns [rad, left > 0]."""
    pieces, ways = min(_words(goal[None]), key=lambda word: float(np.abs(word[0]).sum()))
    kept = [(float(piece), way) for piece, way in zip(pieces[:, 0], ways, strict=True) if abs(float(piece)) > _SAME]
    return [(radius * piece, way * piece) for piece, way in kept]
