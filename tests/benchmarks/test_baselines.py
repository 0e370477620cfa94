from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import fake_plan, with_metrics
from helpers.markdown import cells
from helpers.pages import clips, commands_of

import vkc_pin as vkc
from vkc_pin.benchmarks import baselines, comparison
from vkc_pin.benchmarks.baselines import COMPARED_PLANNERS, TASKS
from vkc_pin.benchmarks.comparison import shown
from vkc_pin.benchmarks.comparison_report import report
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS, MAX_EVALUATIONS
from vkc_pin.benchmarks.harness.record import peaks
from vkc_pin.cli import main
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.statistics import PlanningStatistics
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

GOOD = {"B1": {2, 3}, "B2": {1, 2}, "VKC": {0, 1, 2}}
"""Method → the starts from which `solve` has it succeed."""
BLAME = (
    Violation(
        "penetration",
        "forearm_link – door.panel",
        waypoint=9,
        time=4.0,
        amount=0.03,
        unit="m",
        detail="overlap by 30 mm",
    ),
    Violation(
        "clearance",
        "base_link – block_left",
        waypoint=3,
        time=1.5,
        amount=0.01,
        unit="m",
        detail="10 mm too close",
    ),
    Violation(
        "velocity",
        "elbow_joint",
        waypoint=11,
        time=5.0,
        amount=0.1,
        unit="rad/s",
        detail="0.1 rad/s too fast",
    ),
)


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def solve(scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
    """A plan that nobody planned, in place of the task."""
    method, number = spec["method"], spec["number"]
    good, k = number in GOOD[method], COMPARED_PLANNERS.index(method)
    plan = fake_plan(scene)
    metrics = {
        **plan.trajectory.metrics(),
        **PlanningStatistics(1.0 + number + k, 0.5, 12, 3).to_metrics(),
        "base_path_length": 4.0 + number - k,
        "arm_path_length": 7.0,
        "clearance": np.inf,
        "closure_error": 1e-4,
    }
    validation = Report() if good else Report(BLAME, -0.03)
    status = "success" if good else "rejected" if method == "VKC" else "collision"
    return with_metrics(plan, metrics, status=status, validation=validation, seed=spec["seed"])


class Counting:
    """`solve`, which notes what it was asked for, and is stopped by Ctrl-C after some plans."""

    def __init__(self, until: int = 1000) -> None:
        self.asked: list[str] = []
        self.until = until

    def __call__(self, scene: vkc.Scene, spec: Mapping[str, Any]) -> vkc.Plan:
        if len(self.asked) == self.until:
            return dataclasses.replace(solve(scene, spec), status="interrupted")
        self.asked.append(spec["key"])
        return solve(scene, spec)


def run(out: Path, **changes: Any) -> dict[str, Any]:
    settings = {
        "trials": 3,
        "seed": 5,
        "tasks": ["door"],
        "solve": solve,
        "progress": False,
        **changes,
    }
    return baselines.run(out=out, **settings)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_sources", lambda: "abc")
        run(folder, save_failures=True)
    return folder


@pytest.fixture(scope="module")
def result(out: Path) -> dict[str, Any]:
    return json.loads((out / "results.json").read_text(encoding="utf-8"))


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


# What is run


def test_trials(result: dict[str, Any]) -> None:
    trials = result["trials"]
    assert [(t["number"], t["method"]) for t in trials] == [
        (n, m) for n in range(3) for m in COMPARED_PLANNERS
    ]
    for t in trials:
        assert t["scene"] == "door"  # the task's name, not the scene's
        assert t["seed"] == 5 + t["number"]
        assert t["success"] == (t["number"] in GOOD[t["method"]])
        assert t["duration"] == pytest.approx(6.0)
    meta = result["meta"]
    assert (meta["benchmark"], meta["seed"], meta["starts"], meta["max_evaluations"]) == (
        "baselines",
        5,
        3,
        MAX_EVALUATIONS,
    )
    assert (meta["tasks"], meta["methods"]) == (["door"], list(COMPARED_PLANNERS))
    assert (meta["scenes"], meta["goals"]) == (
        {"door": "corridor_door"},
        {"door": {"door.hinge": 1.5}},
    )


def test_starts_are_drawn_from_seed_and_task_and_the_same_for_all_methods(
    result: dict[str, Any],
) -> None:
    for number in range(3):
        starts = {tuple(t["start"]) for t in result["trials"] if t["number"] == number}
        assert len(starts) == 1
    drawn = {}
    for k, (task, scene) in enumerate((("door", "corridor_door"), ("drawer", "aisle_drawer"))):
        rng, loaded = np.random.default_rng([5, k]), vkc.load_scene(scene)
        drawn[task] = [loaded.sample_start(rng).start[:3].tolist() for _ in range(2)]
    specs = baselines.COMPARISON.specify(
        trials=2, seed=5, tasks=["door", "drawer"], methods=["B1", "VKC"]
    )
    assert [(s["scene"], s["method"], s["number"]) for s in specs] == [
        (task, method, number)
        for task in ("door", "drawer")
        for method in ("B1", "VKC")
        for number in (0, 1)
    ]
    assert all(s["base"] == drawn[s["scene"]][s["number"]] for s in specs)
    (alone,) = baselines.COMPARISON.specify(trials=1, seed=5, tasks=["drawer"], methods=["B2"])
    assert (alone["base"], alone["seed"], alone["key"]) == (drawn["drawer"][0], 5, "drawer/0000/B2")
    np.testing.assert_allclose(result["trials"][0]["start"][:3], drawn["door"][0], atol=1e-8)


def test_the_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []
    for name in ("plan", "plan_separately"):
        monkeypatch.setattr(
            comparison, name, lambda scene, steps, **how: asked.append((scene, list(steps), how))
        )
    for task in TASKS:
        for method in COMPARED_PLANNERS:
            baselines.plan_trial("scene", {"scene": task, "method": method, "seed": 8})  # type: ignore[arg-type]
    door, drawer = vkc.Actuate("door", {"hinge": 1.5}), vkc.Actuate("drawer", {"slide": 0.6})
    common = {**LIMITS, "seed": 8}
    hows = ({**common, "method": "B1", "finer": 2}, {**common, "method": "B2", "finer": 2}, common)
    assert asked == [("scene", [step], how) for step in (door, drawer) for how in hows]


def test_baselines_in_other_numbers_of_waypoints_and_with_other_budgets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(
        comparison, "plan_separately", lambda scene, steps, **how: asked.append(how)
    )
    for method in ("B1", "B1x1", "B2x3"):
        baselines.plan_trial(
            "scene", {"scene": "door", "method": method, "seed": 8, "max_evaluations": 7}
        )  # type: ignore[arg-type]
    common = {**LIMITS, "max_evaluations": 7, "seed": 8}
    assert asked == [
        {**common, "method": "B1", "finer": 2},
        {**common, "method": "B1", "finer": 1},
        {**common, "method": "B2", "finer": 3},
    ]


def test_jobs_make_no_difference(tmp_path: Path, result: dict[str, Any]) -> None:
    assert run(tmp_path, jobs=2)["trials"] == result["trials"]


def test_going_on_after_ctrl_c_gives_the_same(
    tmp_path: Path, result: dict[str, Any], out: Path
) -> None:
    first, second = Counting(4), Counting()
    with pytest.raises(KeyboardInterrupt, match="4 of 9 trials are done"):
        run(tmp_path, solve=first, save_failures=True)
    assert not (tmp_path / "table.md").exists()
    assert files(tmp_path / "failures") == {
        "door_0000_B1.npz",
        "door_0001_B1.npz",
        "door_0000_B2.npz",
    }  # not what was stopped
    assert run(tmp_path, solve=second, save_failures=True)["trials"] == result["trials"]
    assert sorted(first.asked + second.asked[:5]) == [t["key"] for t in result["trials"]]
    assert [key.split("/")[1] for key in second.asked[5:]] == [
        "0002"
    ] * 3  # planned again to be shown
    tables = [
        (folder / "table.md").read_text(encoding="utf-8").splitlines()[:-1]
        for folder in (tmp_path, out)
    ]
    assert tables[0] == tables[1]  # the last line says how long it took
    again = Counting()
    run(tmp_path, solve=again, save_failures=True)
    assert again.asked == []


# Metrics by hand


def test_peaks_against_numbers_by_hand() -> None:
    names = ("x", "y", "yaw", "shoulder", "elbow", "door.hinge")
    positions = [  # base and object are faster than the arm
        [0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [3.0, 4.0, 9.0, 0.5, 1.0, 9.0],
        [3.0, 4.0, 0.0, 0.1, -2.0, 0.0],
        [4.0, 3.0, 0.0, 0.1, -2.6, 0.0],
    ]
    motion = Trajectory(
        names, np.array([0.0, 1.0, 3.0, 3.5]), np.array(positions), (PhaseSpan("move", 0, 3),), 5
    )
    # Velocities: shoulder 0.5, -0.2, 0; elbow 0, -1.5, -1.2. Steps over the shorter of two
    # segments' times: shoulder 0.5 / 1, -0.7 / 1, 0.2 / 0.5, 0 / 0.5; elbow 0, -1.5 / 1, 0.3 / 0.5,
    # 1.2 / 0.5.
    assert peaks(motion) == pytest.approx({"peak_velocity": 1.5, "peak_acceleration": 2.4})
    # Way: 5, 0 and √2; arm: 0.5, 0.4 and 0, and 0, 3 and 0.6.
    expected = {
        "duration": 3.5,
        "base_path_length": 5.0 + np.sqrt(2.0),
        "base_path_length_l1": 9.0,
        "arm_path_length": 4.5,
    }
    assert motion.metrics() == pytest.approx(expected)


def test_records_have_the_peaks_of_their_motions(result: dict[str, Any]) -> None:
    times = fake_plan().trajectory.times
    # Every joint of the arm goes 0.8 s², s from 0 to 1 in even steps over uneven times.
    speeds = 0.8 * np.diff(np.linspace(0.0, 1.0, len(times)) ** 2) / np.diff(times)
    for t in result["trials"]:
        assert t["peak_velocity"] == pytest.approx(speeds.max())
        assert t["peak_acceleration"] > 0.0


# Tables


def test_tables_against_numbers_by_hand(out: Path, result: dict[str, Any]) -> None:
    text = (out / "table.md").read_text(encoding="utf-8")
    sections = {
        part.split("\n", 1)[0]: part.split("\n", 1)[1].strip() for part in text.split("## ")[1:]
    }

    def rows(title: str) -> list[list[str]]:
        return cells(
            "\n".join(
                line for line in sections[title].splitlines() if line.startswith("|")
            ).replace("\\|", "/")
        )[1:]

    assert rows("Success") == [
        ["door", "B1", "1 of 3", "33", "6–79", "0", "collision (penetration) 2"],
        ["door", "B2", "2 of 3", "67", "21–94", "0", "collision (penetration) 1"],
        ["door", "VKC", "3 of 3", "100", "44–100", "0", "none"],
    ]
    assert rows("Planning time") == [
        # 1, 2, 3 of B1; 2, 3, 4 of B2; 3, 4, 5 of VKC. 95th percentile of 1, 2, 3: 2 + 0.9 · 1.
        ["all trials", "door", "B1", "3", "2.00", "2.90", "2.00", "1.00", "0.50"],
        ["all trials", "door", "B2", "3", "3.00", "3.90", "3.00", "1.00", "0.75"],
        ["all trials", "door", "VKC", "3", "4.00", "4.90", "4.00", "1.00", "1.00"],
        ["successes", "door", "B1", "1", "3.00", "3.00", "3.00", "–", "0.75"],
        ["successes", "door", "B2", "2", "3.50", "3.95", "3.50", "0.71", "0.88"],
        ["successes", "door", "VKC", "3", "4.00", "4.90", "4.00", "1.00", "1.00"],
    ]
    common = sections["Efforts, peaks and durations where all methods succeed"]
    assert "all methods succeed: 1 of 3 (door)." in common
    shared = rows("Efforts, peaks and durations where all methods succeed")
    assert shared[0] == ["door", "base [m]", "6.00 ± –; 6.00", "5.00 ± –; 5.00", "4.00 ± –; 4.00"]
    assert [row[1].split(" [")[0] for row in shared] == [
        *("base", "base /dx/+/dy/", "arm", "peak arm velocity", "peak arm acceleration", "duration")
    ]
    pairs = rows("VKC against each baseline")
    assert pairs[0] == ["door", "base [m]", "B1", "4.00", "6.00", "1 of 1"]
    assert pairs[6] == ["door", "planning time [s]", "B1", "5.00", "3.00", "0 of 1"]
    assert pairs[7] == ["door", "base [m]", "B2", "3.50", "4.50", "2 of 2"]
    assert pairs[9] == ["door", "arm [rad]", "B2", "7.00", "7.00", "0 of 2"]
    own = rows("Efforts, peaks and durations over each method's own successes")
    assert own[0] == ["door", "n", "1", "2", "3"]
    assert own[1] == [
        "door",
        "base [m]",
        "6.00 ± –; 6.00",
        "4.50 ± 0.71; 4.50",
        "3.00 ± 1.00; 3.00",
    ]
    failed = rows("Failures")
    assert [row[1:4] + row[5:] for row in failed] == [
        ["0", "B1", "collision", "`failures/door_0000_B1.npz`"],
        ["0", "B2", "collision", "`failures/door_0000_B2.npz`"],
        ["1", "B1", "collision", "`failures/door_0001_B1.npz`"],
    ]
    assert failed[0][4] == str(BLAME[0])
    for picture in ("door.png", "door_joints.png"):
        assert f"]({picture})" in text
        assert (out / picture).read_bytes().startswith(b"\x89PNG")
    assert "Motions of trial 2" in text
    assert "9 trials, 1 at a time" in text.splitlines()[-1]


def test_errors_have_no_times_and_no_path_lengths(result: dict[str, Any]) -> None:
    error = {
        "success": False,
        "status": "error",
        "failed_constraint": "error",
        "violations": ["ValueError: no"],
    }
    odd = {"key": "door/0003/B1", "scene": "door", "method": "B1", "number": 3, **error}
    text = report({**result, "trials": [*result["trials"], odd]}, {"door": "open it"}, title="Odd")
    assert text.startswith("# Odd\n\n`door`: open it. 3 random starts")
    assert "| door | B1 | 1 of 4 | 25 |" in text
    assert "error 1" in text
    assert "| all trials | door | B1 | 3 | 2.00 |" in text
    assert "1 of 4 (door)" in text


def test_without_vkc_there_is_nothing_to_compare_it_with(tmp_path: Path) -> None:
    run(tmp_path, methods=["B2", "B1"], trials=1)
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "VKC against" not in text
    assert "0 of 1 (door)" in text
    assert "![Motions" not in text
    assert not (tmp_path / "door_joints.png").exists()
    assert [row[1] for row in cells(text.split("## Success\n\n")[1].split("\n\n")[0])[1:]] == [
        "B1",
        "B2",
    ]


# Failures and what is shown


def test_failures_are_saved(out: Path, result: dict[str, Any]) -> None:
    assert files(out / "failures") == {"door_0000_B1.npz", "door_0000_B2.npz", "door_0001_B1.npz"}
    saved = vkc.Plan.load(out / "failures" / "door_0001_B1.npz")
    (trial,) = [t for t in result["trials"] if t["key"] == "door/0001/B1"]
    assert saved.claimed is not None
    assert (saved.status, saved.seed, [str(v) for v in saved.claimed.violations]) == (
        "collision",
        6,
        trial["violations"],
    )
    np.testing.assert_allclose(saved.scene.start, trial["start"], atol=1e-8)


def test_failures_are_saved_later_too(tmp_path: Path, out: Path) -> None:
    run(tmp_path)
    assert not (tmp_path / "failures").exists()
    assert "## Failures" not in (tmp_path / "table.md").read_text(encoding="utf-8")
    later = Counting()
    run(tmp_path, solve=later, save_failures=True)
    assert later.asked == ["door/0000/B1", "door/0001/B1", "door/0000/B2"]
    assert files(tmp_path / "failures") == files(out / "failures")
    assert "failures/door_0001_B1.npz" in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_what_succeeds_when_planned_again_is_no_failure_to_look_at(tmp_path: Path) -> None:
    run(tmp_path)
    run(tmp_path, solve=lambda scene, spec: solve(scene, {**spec, "number": 2}), save_failures=True)
    assert files(tmp_path / "failures") == set()
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "## Failures" not in text
    assert "| door | B1 | 1 of 3 |" in text  # the trials count as they were


def test_view_shows_a_failure_with_the_offending_links_in_red(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, file = tmp_path / "failure.html", out / "failures" / "door_0000_B1.npz"
    assert main(["view", str(file), "--html", str(page)]) == 0
    assert str(page) in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert "FAILED, collision" in text
    red: dict[str, list[float]] = {}
    for path, clip in clips(commands_of(text)).items():
        for track in clip["tracks"]:
            if track["type"] == "color":
                red[path] = [
                    key["time"]
                    for key in track["keys"]
                    if key["value"][0] > 0.85 and key["value"][1] < 0.1
                ]
    found = vkc.Plan.load(file).report.violations  # of the motion, not of the file
    close = [
        violation for violation in found if violation.constraint in ("penetration", "clearance")
    ]
    assert close
    for violation in close:
        assert f"{violation.constraint}: {violation.subject.partition(' ')[0]}" in text
        for link in violation.subject.split(" – "):
            moments = [
                moments for path, moments in red.items() if f"/{link.rpartition('.')[2]}/" in path
            ]
            assert all(any(abs(t - violation.time) < 0.5 for t in one) for one in moments), link
    links = {
        link.rpartition(".")[2] for violation in close for link in violation.subject.split(" – ")
    }
    assert red
    assert all(any(f"/{link}/" in path for link in links) for path in red)


@pytest.mark.parametrize(
    ("good", "expected"),
    [
        ({"B1": {1, 2}, "B2": {2, 3}, "VKC": {0, 1, 2, 3}}, 2),
        ({"B1": {1}, "B2": {0}, "VKC": {0, 1}}, 0),
        ({"B1": set(), "B2": {1}, "VKC": {0, 1}}, 1),
        ({"B1": {0, 1}, "B2": {0, 1}, "VKC": {2}}, 2),
        ({"B1": {0, 1}, "B2": {1}, "VKC": set()}, 1),
        ({"B1": set(), "B2": set(), "VKC": set()}, None),
    ],
)
def test_the_trial_that_is_shown(good: dict[str, set[int]], expected: int | None) -> None:
    records = [
        {"scene": "door", "method": m, "number": n, "success": n in good[m]}
        for n in range(4)
        for m in COMPARED_PLANNERS
    ]
    assert shown(records, COMPARED_PLANNERS) == expected


def test_what_is_shown_is_kept(out: Path) -> None:
    assert files(out / "shown") == {f"door_0002_{method}.npz" for method in COMPARED_PLANNERS}
    kept = vkc.Plan.load(out / "shown" / "door_0002_VKC.npz")
    assert kept.claimed is not None
    assert kept.claimed.ok


# Misuse


def test_other_settings_are_refused(out: Path) -> None:
    for changes in ({"trials": 4}, {"seed": 6}, {"methods": ["VKC"]}, {"tasks": ["drawer"]}):
        name = {"trials": "starts"}.get(next(iter(changes)), next(iter(changes)))
        with pytest.raises(InputError, match=rf"{name}.*use another folder"):
            run(out, **changes)


def test_misuse(tmp_path: Path) -> None:
    with pytest.raises(
        UnknownNameError, match=r"there is no task 'drawers'.*did you mean 'drawer'"
    ):
        run(tmp_path, tasks=["drawers"])
    with pytest.raises(UnknownNameError, match=r"there is no method 'B3'.*B1"):
        run(tmp_path, methods=["B3"])
    for nothing in ("tasks", "methods"):
        with pytest.raises(InputError, match=f"{nothing}: there is nothing to run"):
            run(tmp_path, **{nothing: []})
    with pytest.raises(InputError, match=r"trials: out of range.*at least 1.*got 0"):
        run(tmp_path, trials=0)
    assert not files(tmp_path)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--trials", "0"], ["--trials", "at least 1"]),
        (["--tasks", "dor"], ["there is no task 'dor'", "did you mean 'door'"]),
        (["--methods", "VCK"], ["there is no method 'VCK'", "did you mean 'VKC'"]),
        (["--methods"], ["--methods"]),
    ],
)
def test_misuse_on_the_command_line(
    more: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(["bench", "baselines", "--out", str(tmp_path / "out"), *more])
    except SystemExit as stop:
        code = int(str(stop.code))
    said = capsys.readouterr().err
    assert code == 2
    assert all(word in said for word in words), said
    assert not (tmp_path / "out").exists()


def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: dict[str, Any] = {}
    real = baselines.run

    def fake(**given: Any) -> dict[str, Any]:
        asked.update(given)
        return real(**given, solve=solve)

    monkeypatch.setattr(baselines, "run", fake)
    command = [
        "bench",
        "baselines",
        "--trials",
        "2",
        "--seed",
        "4",
        "--jobs",
        "1",
        "--out",
        str(tmp_path),
        "--quiet",
    ]
    assert main([*command, "--tasks", "drawer", "--methods", "VKC", "B1", "--save-failures"]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    said = capsys.readouterr().out
    assert said.startswith(table)
    assert str(tmp_path) in said.splitlines()[-1]
    assert asked == {
        **{
            "trials": 2,
            "seed": 4,
            "jobs": 1,
            "out": str(tmp_path),
            "tasks": ["drawer"],
            "methods": ["VKC", "B1"],
        },
        **{"save_failures": True, "progress": False},
    }
    assert files(tmp_path / "failures") == {"drawer_0000_B1.npz", "drawer_0001_B1.npz"}
    assert "| drawer | VKC | 2 of 2 |" in table
