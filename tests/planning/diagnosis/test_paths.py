"""Tests of the diagnosis of missing paths of base and arm."""

from __future__ import annotations

import numpy as np
from helpers.drives import hall
from helpers.small_problems import SHORT, program_of

import vkc_pin as vkc
from vkc_pin.benchmarks.problems.impossible import KINDS
from vkc_pin.planning.diagnosis.paths import diagnose_paths
from vkc_pin.validation.report import Report, Violation

HIT = Report(
    (
        Violation(
            "penetration", "forearm_link – beam", waypoint=3, amount=0.1, unit="m", detail="overlap"
        ),
    )
)


def across(bottom: float, *, report: Report = HIT, blocked: tuple[str, ...] = ()) -> list[str]:
    """Return the diagnosis of a drive under a beam."""
    beam = {
        "name": "beam",
        "type": "box",
        "size": [0.2, 14.0, 1.5],
        "position": [1.8, 0.0, bottom + 0.75],
    }
    own = program_of(hall(obstacles=[beam]), [vkc.GoTo(3.6, 0.0, 0.0)], options=SHORT)
    z = np.linspace(own.start, own.start + np.eye(len(own.start))[0] * 3.6, own.segments + 1)[1:]
    return diagnose_paths(own, z, report, blocked, 0).lines


def test_no_path_even_with_a_folded_arm() -> None:
    (line,) = across(0.5)
    assert (
        line == "go to: found no path for the base from (0.00, 0.00) to (3.60, 0.00), "
        "and none with the arm folded"
    )


def test_path_for_the_base_but_not_the_arm() -> None:
    (line,) = across(2.0)
    assert (
        line == "go to: found a path for the base from (0.00, 0.00) to (3.60, 0.00), "
        "but none for the arm at the goal"
    )


def test_collision_free_phases_are_not_diagnosed() -> None:
    assert across(0.5, report=Report()) == []
    assert across(
        2.0, report=Report(), blocked=("go to: found no path for the base from here to there",)
    ) == ["go to: found no path for the base from here to there"]


def test_pushed_door_blocks_the_base() -> None:
    """At 1.2 rad the narrow door blocks the base; every known grasp is behind it."""
    scene = vkc.load_scene("household").with_state("door", {"hinge": 1.2})
    plan = vkc.plan(
        scene,
        [vkc.Actuate("door", {"hinge": 0.0}, "push_back")],
        options=vkc.Options(max_restarts=1),
    )
    assert plan.status == "infeasible"
    (note,) = plan.validation.notes
    assert note.startswith(
        "reach door.push_back: found no path for the base from (1.50, -1.00) to any of "
    )
    assert note.endswith(" places from which the goal was reached, and none with the arm folded")
    wide = scene.with_state("door", {"hinge": 1.52})
    assert vkc.plan(wide, [vkc.Grasp("door", "push_back")]).success


def test_missing_path_of_a_later_phase_does_not_cut_off() -> None:
    """The failed motion determines where later phases begin."""
    beam = {"name": "beam", "type": "box", "size": [0.2, 14.0, 1.5], "position": [1.8, 0.0, 1.25]}
    one, two = vkc.GoTo(0.5, 0.0, 0.0), vkc.GoTo(3.6, 0.0, 0.0)
    for steps, cut_off in (([two], True), ([one, two], False)):
        own = program_of(hall(obstacles=[beam]), steps, options=SHORT)
        z = np.tile(own.start, (own.segments, 1))
        z[:, 0] = np.interp(
            np.arange(own.segments) + 1.0, [0, *own.ends], [0.0, 0.5, 3.6][-1 - len(own.ends) :]
        )
        hit = Violation(
            "penetration",
            "forearm_link – beam",
            waypoint=own.segments,
            amount=0.1,
            unit="m",
            detail="overlap",
        )
        found = diagnose_paths(own, z, Report((hit,)), (), 0)
        assert found.is_cut_off == cut_off
        assert "and none with the arm folded" in found.lines[-1]


def test_bend_too_tight_for_the_base() -> None:
    scene, steps = KINDS["bend too tight"](np.random.default_rng(0))
    plan = vkc.plan(scene, steps, options=vkc.Options(max_restarts=1))
    assert not plan.success
    (note,) = plan.validation.notes
    assert "found no path for the base" in note
    assert "and none with the arm folded" in note
