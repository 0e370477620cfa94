"""Tests the diagnosis of missing paths of base and arm."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.drives import make_hall
from helpers.small_problems import SHORT, make_program

import vkc_pin as vkc
from vkc_pin.planning.diagnosis.paths import PathDiagnosis, diagnose_paths
from vkc_pin.validation.report import Report, Violation

NOTE = "go to: found no path for the base from here to there"


def diagnose(
    problem: vkc.TrajectoryProblem,
    z: np.ndarray,
    *,
    hit_waypoint: int | None,
    notes: tuple[str, ...] = (),
) -> PathDiagnosis:
    """Diagnose a motion that collides at waypoint `hit_waypoint`; None: it is free."""
    violations = ()
    if hit_waypoint is not None:
        subject = "forearm_link – beam"
        violations = (
            Violation(
                "penetration", subject, waypoint=hit_waypoint, amount=0.1, unit="m", detail=""
            ),
        )
    return diagnose_paths(problem, z, Report(violations), notes, 0)


def make_beam_case(bottom: float, *xs: float) -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """Return the problem of driving from x to x under a beam, and a straight motion."""
    position = [1.8, 0.0, bottom + 0.75]
    beam = {"name": "beam", "type": "box", "size": [0.2, 14.0, 1.5], "position": position}
    steps = [vkc.GoTo(x, 0.0, 0.0) for x in xs]
    p = make_program(make_hall(obstacles=[beam]), steps, options=SHORT)
    z = np.tile(p.start, (p.segments, 1))
    z[:, 0] = np.interp(np.arange(p.segments) + 1.0, [0, *p.ends], [0.0, *xs])
    return p, z


@pytest.mark.parametrize(
    ("bottom", "expected", "is_cut_off"),
    [
        (0.5, "no path for the base {}, and none with the arm folded", True),
        (2.0, "a path for the base {}, but none for the arm at the goal", False),
    ],
)
def test_colliding_phase_is_explained(bottom: float, expected: str, is_cut_off: bool) -> None:
    p, z = make_beam_case(bottom, 3.6)
    ends = "from (0.00, 0.00) to (3.60, 0.00)"
    found = diagnose(p, z, hit_waypoint=3)
    assert found == (["go to: found " + expected.format(ends)], is_cut_off)
    assert diagnose(p, z, hit_waypoint=None) == ([], False)


def test_notes_of_the_initialization_are_kept_if_nothing_else_is_found() -> None:
    p, z = make_beam_case(2.0, 3.6)
    assert diagnose(p, z, hit_waypoint=None, notes=(NOTE,)).lines == [NOTE]
    p, z = make_beam_case(2.0, 1.0, 3.6)  # two phases with the same name
    assert diagnose(p, z, hit_waypoint=None, notes=(NOTE,)).lines == [NOTE]
    fixed = make_program(make_hall(base="fixed"), [vkc.Reach((0.5, 0.4, 1.0, 0.0, 1.5, 0.0))])
    assert diagnose(fixed, fixed.still, hit_waypoint=3, notes=(NOTE,)) == ([NOTE], False)


def test_missing_path_of_a_later_phase_does_not_cut_off() -> None:
    """The failed motion determines where later phases begin."""
    p, z = make_beam_case(0.5, 0.5, 3.6)
    found = diagnose(p, z, hit_waypoint=p.segments)
    assert not found.is_cut_off
    (line,) = found.lines
    assert line.startswith("go to: found no path for the base from (0.50, 0.00) to (3.60, 0.00)")


@pytest.mark.parametrize("hinge", [1.2, 1.52])
def test_narrow_door_blocks_the_base_until_it_is_wide_open(hinge: float) -> None:
    """At 1.2 rad the narrow door blocks the base; every known grasp is behind it."""
    scene = vkc.load_scene("household").with_state("door", {"hinge": hinge})
    p = make_program(scene, [vkc.Grasp("door", "push_back")])
    found = diagnose(p, p.still, hit_waypoint=p.segments)
    if hinge == 1.2:
        (line,) = found.lines
        start = "reach door.push_back: found no path for the base from (1.50, -1.00) to any of "
        assert line.startswith(start)
        assert line.endswith("places from which the goal was reached, and none with the arm folded")
    assert found.is_cut_off == (hinge == 1.2)
