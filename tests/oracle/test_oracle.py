"""Tests that the oracle accepts valid plans, finds faults in changed ones, and is independent."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drives import make_hall
from helpers.telescopes import write_coupled_scene

import vkc_pin as vkc
from oracle.__main__ import main
from oracle.changes import write_changed
from oracle.judge import judge
from oracle.plan import read_plan
from oracle.stage import World

Content = dict[str, Any]

TASKS = {
    "drawer": ("drawer", [vkc.Actuate("drawer", {"slide": 0.3})]),
    "cup": ("household", [vkc.Place("cup", (-0.6, -1.6, 0.751))]),
    "stick": ("init_1", [vkc.Grasp("stick"), vkc.Touch("stick.tip", (-1.0, 3.897, 0.1))]),
    "leave": ("fetch", [vkc.Grasp("cabinet"), vkc.Touch("tool", (0.0, -0.5, 1.0))]),
}


@pytest.fixture(scope="module")
def plans(tmp_path_factory: pytest.TempPathFactory, door_plan: vkc.Plan) -> dict[str, Path]:
    """Return saved plans; of the last, the next step releases the handle at once."""
    folder, planned = tmp_path_factory.mktemp("plans"), {"door": door_plan}
    for name, (scene, steps) in TASKS.items():
        planned[name] = vkc.plan(vkc.load_scene(scene), steps)
        assert planned[name].success, planned[name].summary()
    return {name: plan.save(folder / f"{name}.npz") for name, plan in planned.items()}


def test_valid_plans_pass(plans: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    code = main([str(next(iter(plans.values())).parent)])
    output = capsys.readouterr().out
    assert code == 0, output
    assert "| success | success, and nothing found | 5 |" in output


# Changes: plan, change, violated rule and beginning of the subject.


def _move_start(c: Content) -> None:
    c["scene"]["start"]["base"][0] += 0.01


def _exceed_limit(c: Content) -> None:
    c["column"]("elbow_joint")[20:30] = 3.3


def _jump(c: Content) -> None:
    c["column"]("base_x")[20] += 0.5


def _speed_up(c: Content) -> None:
    c["times"][:] *= 0.2


def _leave_arena(c: Content) -> None:
    c["scene"]["arena"]["x"][0] = float(c["column"]("base_x").min()) + 0.05


def add_obstacle(c: Content, name: str, kind: str, position: list[float], **size: Any) -> None:
    c["scene"]["obstacles"].append({"name": name, "type": kind, "position": position, **size})


def _add_wall(c: Content) -> None:
    k = int(np.argmax(np.abs(np.diff(c["column"]("base_x")))))
    x, y = (float(c["column"](name)[k : k + 2].mean()) for name in ("base_x", "base_y"))
    add_obstacle(c, "post", "cylinder", [x, y, 0.3], radius=0.02, length=0.2)


def _drift(c: Content) -> None:
    c["column"]("base_x")[48:] += np.linspace(0.0, 0.004, len(c["times"]) - 48)


def _move_latched_joint(c: Content) -> None:
    c["column"]("door.knob")[47:] = 0.3


def _stop_short(c: Content) -> None:
    c["steps"][-1]["joints"] = {"hinge": 1.21}


def _remove_grasp(c: Content) -> None:
    c["phases"][-1]["held"] = {}


def _slide(c: Content) -> None:
    c["column"]("cup.side_turn")[60:] += 0.02


def _remove_rest(c: Content) -> None:
    c["times"][41:] -= 0.9


def _move_goal(c: Content) -> None:
    c["steps"][-1]["pose"][0] += 0.005


def _keep_grasp(c: Content) -> None:
    c["phases"][-1]["held"] = dict(c["phases"][-2]["held"])


def _move_stick(c: Content) -> None:
    for item in c["scene"]["objects"]:
        if item["name"] == "stick":
            item["position"][0] += 0.003


def _prepend_step(c: Content) -> None:
    x, y = (float(c["column"](name)[-1]) for name in ("base_x", "base_y"))
    c["steps"].insert(0, {"step": "GoTo", "x": x, "y": y, "yaw": None})


def _block_drawer(c: Content) -> None:
    x, y, _ = c["scene"]["objects"][0]["position"]
    in_front = [x - 0.28, y, 0.0]  # of the handle: overlaps at the start are exempt
    add_obstacle(c, "box", "box", in_front, size=[0.05, 0.05, 3.0])


def _take_table_away(c: Content) -> None:
    tables = [one for one in c["scene"]["obstacles"] if one["name"] != "dining_table"]
    c["scene"]["obstacles"] = tables


def _weaken_arm(c: Content) -> None:
    c["options"]["payload_factor"] = 0.05


CHANGES: list[tuple[str, Callable[[Content], None], str, str]] = [
    ("door", _move_start, "start", "base_x"),
    ("door", _exceed_limit, "limit", "elbow_joint"),
    ("door", _jump, "velocity", "base_x"),
    ("door", _jump, "acceleration", "base_x"),
    ("cup", _speed_up, "acceleration", "shoulder"),
    ("drawer", _leave_arena, "limit", "base_x"),
    ("drawer", _add_wall, "overlap", "base_link - post"),
    ("door", _drift, "closure", "door.handle"),
    ("door", _move_latched_joint, "latch", "door.hinge"),
    ("door", _stop_short, "goal", "door.hinge"),
    ("door", _remove_grasp, "unheld", "door.hinge"),
    ("cup", _slide, "slide", "cup.side_turn"),
    ("drawer", _remove_rest, "dwell", "drawer"),
    ("cup", _move_goal, "goal", "cup.cup"),
    ("cup", _keep_grasp, "goal", "cup"),
    ("cup", _take_table_away, "support", "cup"),
    ("cup", _weaken_arm, "payload", "cup"),
    ("stick", _move_stick, "closure", "stick.grip"),
    ("door", _prepend_step, "order", "steps"),
    ("drawer", _block_drawer, "overlap", "drawer."),
]


@pytest.mark.parametrize(
    ("name", "change", "rule", "subject"),
    CHANGES,
    ids=[f"{c[0]}{c[1].__name__}-{c[2]}" for c in CHANGES],
)
def test_faults_of_changed_plans_are_found(
    plans: dict[str, Path],
    tmp_path: Path,
    name: str,
    change: Callable[[Content], None],
    rule: str,
    subject: str,
) -> None:
    verdict = judge(write_changed(plans[name], tmp_path / "changed.npz", change))
    assert verdict.success  # its own report is unchanged
    assert any(
        violation.rule == rule and violation.subject.startswith(subject)
        for violation in verdict.found
    ), list(map(str, verdict.found))


def _move_sideways(c: Content) -> None:
    yaw, share = c["column"]("base_yaw"), np.linspace(0.0, 0.05, len(c["times"]))
    c["column"]("base_x")[:] -= share * np.sin(yaw)
    c["column"]("base_y")[:] += share * np.cos(yaw)


def _turn_in_place(c: Content) -> None:
    for name in ("base_x", "base_y"):
        c["column"](name)[:] = c["column"](name)[0]


@pytest.mark.parametrize("base", ["differential", "ackermann"])
def test_slipping_and_fast_wheels_are_found(base: str, tmp_path: Path) -> None:
    """A base must not slip, turn against its kinematics or exceed its wheel speed."""
    robot = {"base": base, **({"turning_radius": 0.8} if base == "ackermann" else {})}
    plan = vkc.plan(make_hall(**robot), [vkc.GoTo(1.5, 0.8, 0.3)])
    assert plan.success, plan.summary()
    path = plan.save(tmp_path / "plan.npz")
    assert judge(path).agrees
    sideways, in_place, fast = (
        {one.rule for one in judge(write_changed(path, tmp_path / "changed.npz", change)).found}
        for change in (_move_sideways, _turn_in_place, _speed_up)
    )
    assert "slip" in sideways
    assert ("turning" in in_place) == (base == "ackermann")
    assert "slip" not in in_place
    assert "wheels" in fast


def test_shape_within_the_clearance_is_found(plans: dict[str, Path], tmp_path: Path) -> None:
    """A ball 15 mm above the base violates the clearance; a ball at 25 mm does not."""

    def find_amounts(height: float) -> list[tuple[str, float]]:
        def change(c: Content) -> None:
            for column in c["positions"].T:
                column[1:] = column[0]
            x, y, yaw = (float(c["column"](f"base_{name}")[0]) for name in ("x", "y", "yaw"))
            above = [x - 0.3 * np.cos(yaw), y - 0.3 * np.sin(yaw), 0.39 + height + 0.01]
            add_obstacle(c, "ball", "sphere", above, radius=0.01)

        found = judge(write_changed(plans["drawer"], tmp_path / "b.npz", change)).found
        return [(one.subject, one.amount) for one in found if one.rule == "clearance"]

    assert find_amounts(0.015) == [("base_link - ball", pytest.approx(0.019 - 0.015, abs=1e-3))]
    assert find_amounts(0.025) == []


def test_cup_in_a_drawer_moves_with_it(plans: dict[str, Path], tmp_path: Path) -> None:
    """A cup in the drawer's tray moves with it by 0.3 m, although the plan does not mention it."""
    path = write_changed(plans["drawer"], tmp_path / "changed.npz", _add_cup)
    stages = list(World(read_plan(path)).iterate_stages())
    assert [stage.supports for stage in stages[:-1]] == [{}] * (len(stages) - 1)
    assert stages[-1].supports == {"cup": ("drawer", "tray")}
    translations = stages[-1].links["cup", "cup"].translation
    assert np.linalg.norm(translations[-1] - translations[0]) == pytest.approx(0.3, abs=2e-3)
    assert judge(path).agrees


def _add_cup(c: Content) -> None:
    x, y, _ = c["scene"]["objects"][0]["position"]
    # The cup is 1 mm above the tray's bottom.
    c["scene"]["objects"].append({"name": "cup", "type": "cup", "position": [x + 0.15, y, 0.653]})


def test_cup_on_a_tilting_door_tips(plans: dict[str, Path], tmp_path: Path) -> None:
    """A cup on a dishwasher's door tips over when the door closes slightly.

    No hand grasps the door, which is another violation.
    """

    def change(c: Content) -> None:
        washer = next(item for item in c["scene"]["objects"] if item["type"] == "dishwasher")
        x, y, _ = washer["position"]
        (other,) = [item for item in c["scene"]["objects"] if item["name"] == "cold_cup"]
        other["position"] = [x, y - 0.35, 0.1335]  # 1 mm above the door
        c["names"].append("dishwasher.door")
        values = np.full(len(c["times"]), 1.57)
        values[60:] = 1.4
        c["positions"] = np.column_stack([c["positions"], values])

    found = judge(write_changed(plans["cup"], tmp_path / "changed.npz", change)).found
    (tipped,) = [one for one in found if one.rule == "tips"]
    assert (tipped.subject, tipped.amount) == ("cold_cup", pytest.approx(0.17 - 0.1, abs=2e-3))
    assert "unheld dishwasher.door" in {f"{one.rule} {one.subject}" for one in found}


INERTIAL = (
    '<inertial><origin xyz="0.05 0 0.02"/><mass value="2"/>'
    '<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def load_coupled_robot(folder: Path, effort: float) -> vkc.Scene:
    """Return a scene whose robot has coupled joints, moving links of 2 kg and effort limits."""
    scene = write_coupled_scene(folder)
    file = folder / "robot.urdf"
    urdf = file.read_text(encoding="utf-8").replace('effort="10"', f'effort="{effort}"')
    moving = r'<link name="(segment_\d|yaw|pitch|roll|hand)">'
    urdf = re.sub(moving, lambda match: match.group(0) + INERTIAL, urdf)
    file.write_text(urdf, encoding="utf-8")
    return vkc.Scene.from_document(scene.document, folder)


def test_torques_of_coupled_joints_agree_with_validation(tmp_path: Path) -> None:
    """The lift also turns the wrist: its motor accelerates both, at first by 155.5 N."""
    scene = load_coupled_robot(tmp_path, 1000.0)
    goal = scene.with_start(base=scene.start[:3], arm=scene.start[3:] + np.array([0.3, 0.1, 0.5]))
    plan = vkc.plan(scene, [vkc.Reach(goal.tool_placement())])
    assert plan.success, plan.summary()
    limit = 152.5  # holds the arm at rest
    weak = load_coupled_robot(tmp_path, limit)
    report = vkc.validate(weak, plan.steps, plan.trajectory, plan.options)
    (expected,) = report.violations
    changed = dataclasses.replace(plan, scene=weak, report=report, status="rejected")
    (found,) = judge(changed.save(tmp_path / "weak.npz")).found
    assert (found.rule, found.subject) == (expected.constraint, expected.subject)
    assert found.subject == "lift"
    assert found.amount + 0.01 * limit == pytest.approx(expected.amount, abs=1e-2)
    load_coupled_robot(tmp_path, 1000.0)  # restored, since the plan is judged again


def test_oracle_does_not_import_the_package(plans: dict[str, Path]) -> None:
    code = "import sys; sys.modules['vkc_pin'] = None; sys.path.insert(0, sys.argv[1])\n"
    code += "from oracle.judge import judge; from pathlib import Path\n"
    code += "import json; print(json.dumps([judge(Path(path)).agrees for path in sys.argv[2:]]))"
    command = [
        sys.executable,
        "-c",
        code,
        str(Path(__file__).parents[1]),
        *map(str, plans.values()),
    ]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert json.loads(process.stdout) == [True] * len(plans)


@pytest.mark.parametrize("module", ["tests.oracle", "tests.oracle.executed"])
def test_documented_commands_start(module: str) -> None:
    """They run from a checkout, without the paths that pytest adds."""
    command = [sys.executable, "-m", module, "--help"]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
