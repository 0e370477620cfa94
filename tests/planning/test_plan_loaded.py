"""Tests that the claims of loaded files are validated."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import casadi
import pytest

import vkc_pin as vkc
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.task.terms import trace_terms


def test_failed_plan_keeps_its_violations(door_plan: vkc.Plan, tmp_path: Path) -> None:
    violation = Violation(
        "penetration",
        "forearm_link – sofa",
        waypoint=9,
        time=4.0,
        amount=0.03,
        unit="m",
        detail="overlap by 30 mm",
    )
    report = Report(
        (violation,),
        float("inf"),
        closure_error=1e-4,
        closure_angle=2e-4,
        states=77,
        notes=("the sofa stands in the way",),
    )
    positions = door_plan.trajectory.positions.copy()
    positions[5, 2] += 1.5  # a report with violations belongs to an invalid motion
    bent = dataclasses.replace(door_plan.trajectory, positions=positions, curve=None)
    failed = dataclasses.replace(door_plan, trajectory=bent, report=report, status="infeasible")
    loaded = vkc.Plan.load(failed.save(tmp_path / "failed.npz"))
    assert (loaded.success, loaded.status, loaded.claimed) == (False, "infeasible", report)
    assert (loaded.report.violations, loaded.report.notes) == ((violation,), report.notes)
    late = dataclasses.replace(
        failed, status="time limit"
    )  # violations are then recomputed from the motion
    loaded = vkc.Plan.load(late.save(tmp_path / "late.npz"))
    assert {v.constraint for v in loaded.report.violations} == {
        "velocity",
        "acceleration",
        "torque",
    }
    assert (loaded.success, loaded.status, loaded.report.notes) == (
        False,
        "time limit",
        report.notes,
    )


def invalidate_motion(plan: vkc.Plan) -> vkc.Plan:
    """Return the plan with an invalid motion and its old report."""
    positions = plan.trajectory.positions.copy()
    positions[5, 2] += 1.5
    return dataclasses.replace(
        plan, trajectory=dataclasses.replace(plan.trajectory, positions=positions, curve=None)
    )


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


def test_reasons_of_an_infeasible_task_are_loaded(door_plan: vkc.Plan, tmp_path: Path) -> None:
    violation = Violation("penetration", "a – b", amount=0.03, unit="m", detail="overlap by 30 mm")
    failed = dataclasses.replace(
        invalidate_motion(door_plan),
        status="infeasible",
        report=Report((violation,), notes=("so it is",)),
    )
    path = failed.save(tmp_path / "failed.npz")
    assert vkc.Plan.load(path).report.violations == (violation,)
    assert vkc.Plan.load(path).report.notes == ("so it is",)
    valid = dataclasses.replace(door_plan, status="infeasible", report=failed.report)
    loaded = vkc.Plan.load(valid.save(path))
    assert (loaded.report.ok, loaded.success) == (True, False)
    assert "1 constraint(s) violated" in loaded.contradictions()


def test_motion_of_another_robot_is_refused(door_plan: vkc.Plan, tmp_path: Path) -> None:
    names = ("arm", *door_plan.trajectory.names[1:])
    path = dataclasses.replace(
        door_plan, trajectory=dataclasses.replace(door_plan.trajectory, names=names)
    ).save(tmp_path / "a")
    with pytest.raises(
        vkc.InputError, match=r"trajectory.names: not this robot's coordinates"
    ) as caught:
        vkc.Plan.load(path)
    assert caught.value.file == path


def test_motion_out_of_range(door_plan: vkc.Plan, tmp_path: Path) -> None:
    for value, field in ((1e6, None), (1e100, "trajectory.positions")):
        positions = door_plan.trajectory.positions.copy()
        positions[5, 0] = value
        trajectory = dataclasses.replace(door_plan.trajectory, positions=positions, curve=None)
        path = dataclasses.replace(door_plan, trajectory=trajectory).save(tmp_path / "far")
        if field is None:
            loaded = vkc.Plan.load(path)
            assert not loaded.success
            assert "sampling" in {violation.constraint for violation in loaded.report.violations}
            continue
        with pytest.raises(vkc.InputError, match=field) as caught:
            vkc.Plan.load(path)
        assert caught.value.file == path


@pytest.mark.parametrize("amount", [float("inf"), 1e308, 0.5])
@pytest.mark.parametrize("ratio", [float("inf"), float("nan"), -float("inf"), 0.5])
def test_plan_with_non_finite_numbers_is_saved_and_loaded(
    door_plan: vkc.Plan, tmp_path: Path, amount: float, ratio: float
) -> None:
    violation = Violation("term", "c", amount=amount, unit="", detail="too much")
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
