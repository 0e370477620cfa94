"""Tests that the claims of loaded files are validated."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import casadi
import pytest
from helpers.fake_plan import VIOLATION

import vkc_pin as vkc
from vkc_pin.validation.report import Report
from vkc_pin.world.task.terms import trace_terms


def invalidate_motion(plan: vkc.Plan, size: float = 1.5) -> vkc.Plan:
    """Return the plan with a heading that jumps by `size` [rad], and its old report."""
    positions = plan.trajectory.positions.copy()
    positions[5, 2] += size
    bent = dataclasses.replace(plan.trajectory, positions=positions, curve=None)
    return dataclasses.replace(plan, trajectory=bent)


def test_failed_plan_keeps_its_violations(door_plan: vkc.Plan, tmp_path: Path) -> None:
    """Reasons of an infeasible task are loaded, other violations are those of the motion."""
    notes = ("the sofa stands in the way",)
    errors = {"closure_error": 1e-4, "closure_angle": 2e-4}
    report = Report((VIOLATION,), float("inf"), **errors, states=77, notes=notes)
    failed = dataclasses.replace(invalidate_motion(door_plan), report=report, status="infeasible")
    for status, violated in (
        ("infeasible", {"penetration"}),
        ("time limit", {"velocity", "acceleration", "torque"}),
    ):
        plan = dataclasses.replace(failed, status=status)
        loaded = vkc.Plan.load(plan.save(tmp_path / "failed.npz"))
        assert (loaded.success, loaded.status, loaded.claimed) == (False, status, report)
        assert {v.constraint for v in loaded.report.violations} == violated
        assert loaded.report.notes == notes
    valid = dataclasses.replace(door_plan, status="infeasible", report=report)
    loaded = vkc.Plan.load(valid.save(tmp_path / "valid.npz"))
    assert (loaded.report.ok, loaded.success) == (True, False)
    assert "1 constraint(s) violated" in loaded.contradictions()


def test_success_is_validated(door_plan: vkc.Plan, tmp_path: Path) -> None:
    bad = invalidate_motion(door_plan)
    assert bad.success
    loaded = vkc.Plan.load(bad.save(tmp_path / "bad.npz"))
    assert (loaded.success, loaded.status) == (False, "rejected")
    assert loaded.summary().startswith("door: FAILED, rejected")
    assert loaded.to_dict()["status"] == "rejected"
    assert repr(loaded).startswith("<Plan rejected")
    assert loaded.claimed is not None
    assert loaded.claimed.ok
    assert "every constraint holds" in loaded.contradictions()
    again = vkc.Plan.load(loaded.save(tmp_path / "again.npz"))
    assert (again.success, again.contradictions()) == (False, [])


def test_report_without_validation_is_the_claim_of_the_file(
    door_plan: vkc.Plan, tmp_path: Path
) -> None:
    path = invalidate_motion(door_plan).save(tmp_path / "bad.npz")
    loaded = vkc.Plan.load(path, validate=False)
    assert (loaded.is_validated, loaded.success) == (False, False)
    assert loaded.report == loaded.claimed == door_plan.report
    with pytest.raises(vkc.InputError, match="validate"):
        vkc.Plan.load(path, validate="no")  # type: ignore[arg-type]


def test_motion_of_another_robot_is_refused(door_plan: vkc.Plan, tmp_path: Path) -> None:
    names = ("arm", *door_plan.trajectory.names[1:])
    motion = dataclasses.replace(door_plan.trajectory, names=names)
    path = dataclasses.replace(door_plan, trajectory=motion).save(tmp_path / "a")
    problem = r"trajectory.names: not this robot's coordinates"
    with pytest.raises(vkc.InputError, match=problem) as caught:
        vkc.Plan.load(path)
    assert caught.value.file == path


def test_motion_out_of_range(door_plan: vkc.Plan, tmp_path: Path) -> None:
    loaded = vkc.Plan.load(invalidate_motion(door_plan, 1e6).save(tmp_path / "far"))
    assert not loaded.success
    assert "sampling" in {violation.constraint for violation in loaded.report.violations}
    path = invalidate_motion(door_plan, 1e100).save(tmp_path / "farther")
    with pytest.raises(vkc.InputError, match=r"trajectory\.positions") as caught:
        vkc.Plan.load(path)
    assert caught.value.file == path


@pytest.mark.parametrize("amount", [float("inf"), 1e308])
@pytest.mark.parametrize("ratio", [float("inf"), float("nan"), -float("inf")])
def test_plan_with_non_finite_numbers_is_saved_and_loaded(
    door_plan: vkc.Plan, tmp_path: Path, amount: float, ratio: float
) -> None:
    violation = dataclasses.replace(VIOLATION, amount=amount)
    failed = dataclasses.replace(
        door_plan,
        report=dataclasses.replace(door_plan.report, violations=(violation,)),
        status="infeasible",
        history=({**door_plan.history[0], "ratio": ratio},),
    )
    loaded = vkc.Plan.load(failed.save(tmp_path / "plan.npz"), validate=False)
    assert loaded.report.violations == (violation,)
    assert str(loaded.history[0]["ratio"]) == str(ratio)
    text = failed.to_json(tmp_path / "plan.json").read_text(encoding="utf-8")
    data = json.loads(text, parse_constant=pytest.fail)
    assert data["violations"][0]["amount"] == (None if amount == float("inf") else amount)
    motion = vkc.Trajectory.from_json(tmp_path / "plan.json")
    assert motion.to_dict() == door_plan.trajectory.to_dict()


def test_plan_with_an_overflowing_term_is_saved_and_loaded(
    door_plan: vkc.Plan, tmp_path: Path
) -> None:
    def overflow(state: vkc.State) -> Any:
        return casadi.exp(casadi.exp(200.0 + state.coordinate("base_x")))

    terms = trace_terms(door_plan.scene, [vkc.Constraint("c", overflow, upper=1.0)])
    report = vkc.validate(door_plan.scene, door_plan.steps, door_plan.trajectory, terms=terms)
    plan = dataclasses.replace(door_plan, terms=terms, report=report, status="time limit")
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert [(v.subject, v.amount) for v in loaded.report.violations] == [("c", float("inf"))]
    assert loaded.contradictions() == []
