"""Every notebook runs from top to bottom, and its cells show what they should."""

from __future__ import annotations

import ast
import base64
import html
import itertools
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import vkc_pin as vkc

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
Cells = dict[str, nbformat.NotebookNode]


def load(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def executed(name: str, folder: Path) -> Cells:
    """Run a notebook in a folder of its own, and keep it with its outputs for the site; return its cells by their ids."""
    (path,) = (path for path in NOTEBOOKS if path.stem == name)
    notebook = load(path)
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    (ROOT / "out" / "notebooks").mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, ROOT / "out" / "notebooks" / path.name)
    return {cell.id: cell for cell in notebook.cells}


def text(cell: nbformat.NotebookNode) -> str:
    """Return what a cell printed."""
    return "".join(
        output.text
        for output in cell.outputs
        if output.output_type == "stream" and output.name == "stdout"
    )


def result(cell: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Return the data of a cell's value, by MIME type."""
    (found,) = (output.data for output in cell.outputs if output.output_type == "execute_result")
    return found


def drawn_size(cell: nbformat.NotebookNode) -> tuple[int, int]:
    """Return width and height of the PNG that pyplot leaves at the end of a cell [pixels]."""
    (found,) = (output.data for output in cell.outputs if output.output_type == "display_data")
    return png_size(found)


def size(cell: nbformat.NotebookNode) -> tuple[int, int]:
    """Return width and height of the PNG that is a cell's value [pixels]."""
    return png_size(result(cell))


def png_size(shown: nbformat.NotebookNode) -> tuple[int, int]:
    data = base64.b64decode(shown["image/png"])
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def table(markdown: str) -> list[dict[str, str]]:
    """Return the rows of a table in Markdown."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines()]
    return [dict(zip(rows[0], row, strict=True)) for row in rows[2:]]


def test_every_notebook_is_tested() -> None:
    tested = set(re.findall(r'executed\("(\w+)"', Path(__file__).read_text(encoding="utf-8")))
    assert NOTEBOOKS
    assert {path.stem for path in NOTEBOOKS} == tested


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_kept_without_outputs(path: Path) -> None:
    notebook = load(path)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    for cell in notebook.cells:
        assert not cell.metadata, cell.id
        if cell.cell_type == "code":
            assert (cell.outputs, cell.execution_count) == ([], None), cell.id


@pytest.mark.timeout(600)
def test_first_plan(tmp_path: Path) -> None:
    cells = executed("01_first_plan", tmp_path)

    code = [cell for cell in cells.values() if cell.cell_type == "code"]
    until = [cell.id for cell in code].index("show") + 1
    lines = [line for cell in code[:until] for line in cell.source.splitlines() if line.strip()]
    assert len(lines) == 7
    assert until == 4
    assert "seven lines of code, those of the next four cells" in cells["intro"].source

    assert "husky_ur5e" in result(cells["scene"])["text/html"]
    assert text(cells["plan"]).startswith(
        "door: success — reach door.handle, turn door.knob, move door.hinge, door.knob"
    )
    assert "every constraint holds" in text(cells["plan"])
    assert "<table" in result(cells["overview"])["text/html"]
    assert "data:image/png" in result(cells["overview"])["text/html"]
    view = result(cells["show"])["text/html"]
    assert "iframe" in view
    assert len(view) > 100_000  # the whole film
    assert min(size(cells["plot"])) > 300

    # What is on disk, read here, is what the cells say; and it is what was asked for.
    plan = vkc.Plan.load(tmp_path / "door.npz")
    motion = plan.trajectory
    assert vkc.validate(
        vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})], motion, vkc.Options()
    ).ok
    assert abs(motion.column("door.hinge")[-1] - 1.2) < 1e-3
    shapes, names, *phases = text(cells["arrays"]).splitlines()
    assert shapes == f"times {motion.times.shape} positions {motion.positions.shape}"
    assert names.split() == list(motion.names)
    edges = [
        f"{motion.times[phase.first]:.1f} {motion.times[phase.last]:.1f} {phase.name}"
        for phase in motion.phases
    ]
    assert [
        " ".join(re.findall(r"([\d.]+) s to +([\d.]+) s  (.*)", line)[0]) for line in phases
    ] == edges
    half_way = ast.literal_eval(result(cells["at"])["text/plain"])
    assert half_way == pytest.approx(
        dict(zip(motion.names, motion.at(motion.times[-1] / 2), strict=True)), abs=6e-4
    )
    assert "wrist_3_joint" in text(cells["files"])
    count = int(re.findall(r"(\d+) points", text(cells["files"]))[0])
    assert -2 < count - 100 * motion.times[-1] < 8  # and where it comes to rest or leaves it
    assert (
        len((tmp_path / "door.csv").read_text(encoding="utf-8").splitlines())
        == len(motion.curve.times) + 1
    )
    assert (tmp_path / "door.html").stat().st_size > 100_000
    assert result(cells["again"])["text/plain"].count("True") == 3


@pytest.mark.long
@pytest.mark.timeout(600)
def test_virtual_kinematic_chain(tmp_path: Path) -> None:
    cells = executed("02_virtual_kinematic_chain", tmp_path)

    # A joint a line: name, what it is below, kind, limits.
    tables = {
        name: [line.split() for line in text(cells[name]).splitlines()[1:]]
        for name in ("urdf", "inverted", "chain")
    }
    limits = {name: row[3:] for row in tables["urdf"] for name in row[:1]}
    assert limits == {
        "hinge": ["-1.57", "1.57"],
        "knob": ["0.00", "0.80"],
    }  # as they stand in door.urdf
    assert [row[:2] for row in tables["urdf"]] == [["hinge", "universe"], ["knob", "hinge"]]
    assert [row[:3] for row in tables["inverted"]] == [
        ["knob", "universe", "RZ"],
        ["hinge", "knob", "RZ"],
    ]
    assert {row[0]: row[3:] for row in tables["inverted"]} == limits
    *joints, last = tables["chain"]
    assert joints[0][:3] == ["base", "universe", "Planar"]
    assert [row[1] for row in joints[1:]] == [
        row[0] for row in joints[:-1]
    ]  # one chain, without branches
    assert [row[:1] + row[3:] for row in joints[-2:]] == [
        [f"door.{name}", *limits[name]] for name in ("knob", "hinge")
    ]
    assert last[:2] == ["11", "coordinates:"]
    assert len(last) == 2 + 11

    assert 0.0 < float(text(cells["same"]).split()[-1]) < 1e-12
    status, _, waypoints, *_ = text(cells["plan"]).split()
    assert status == "success"
    assert int(waypoints) > 20
    off = {
        name: float(value)
        for name, value in re.findall(r"^(\S+) +([\d.]+) mm$", text(cells["compare"]), re.MULTILINE)
    }
    assert set(off) == {"wrist_3_link", "tool", "door.frame", "door.panel", "door.lever"}
    assert off["wrist_3_link"] == off["tool"] == 0.0  # to the last of six digits
    assert all(0.0 < off[f"door.{link}"] < 1.0 for link in ("frame", "panel", "lever"))
    assert float(text(cells["report"]).split()[-2]) < 1.0
    view = html.unescape(result(cells["show"])["text/html"])
    assert "iframe" in view
    assert len(view) > 100_000
    assert [float(line.split()[-1]) for line in text(cells["axes"]).splitlines()] == [-1.0, -1.0]


@pytest.mark.long
@pytest.mark.timeout(600)
def test_optimisation_problem(tmp_path: Path) -> None:
    cells = executed("03_optimisation_problem", tmp_path)

    # The equations are those of the page on the mathematics.
    page = (ROOT / "docs" / "formulation.md").read_text(encoding="utf-8")
    stated = re.findall(r"^(.*)&& (\(\d\))", page, re.MULTILINE)
    assert [number for _, number in stated] == [f"({k})" for k in range(1, 8)]
    assert re.findall(r"^(.*)&& (\(\d\))", cells["equations"].source, re.MULTILINE) == stated

    built = result(cells["build"])["text/plain"]
    segments, variables, rows = (
        int(re.findall(rf"(\d+) {what}", built)[0]) for what in ("steps", "variables", "rows")
    )
    counts = {
        kind: int(number)
        for number, kind in re.findall(r"^ *(\d+)  (.+)$", text(cells["sizes"]), re.MULTILINE)
    }
    assert (
        sum(number for kind, number in counts.items() if kind.startswith("variables"))
        == variables
        == (11 + 4 + 1) * segments
    )
    assert sum(number for kind, number in counts.items() if kind.startswith("rows")) == rows
    assert counts["rows: closure door"] > 7 * segments // 3
    for name in ("spy", "along", "convergence"):
        assert min(drawn_size(cells[name])) > 200

    violations = int(re.findall(r"seed: (\d+) violations", text(cells["start"]))[0])
    assert violations > 0
    distance, value = map(float, re.findall(r"([-\d.]+) mm", text(cells["plane"])))
    assert distance == pytest.approx(value, abs=1e-3)
    slopes = [tuple(map(float, line.split()[1:])) for line in text(cells["gradient"]).splitlines()]
    assert len(slopes) == 11
    assert max(abs(slope) for slope, _ in slopes) > 0.1
    assert [slope for slope, _ in slopes] == pytest.approx(
        [difference for _, difference in slopes], abs=0.01
    )

    *lines, last = text(cells["solve"]).splitlines()
    told = [
        re.findall(
            r"^ *(\d+) objective ([\d.]+), short ([\d.]+) mm, .*: (accepted|rejected)$", line
        )[0]
        for line in lines
    ]
    assert [int(number) for number, *_ in told] == list(range(1, len(told) + 1))
    accepted = [
        (float(objective), float(short))
        for _, objective, short, verdict in told
        if verdict == "accepted"
    ]
    seed = float(re.findall(r"objective ([\d.]+)", text(cells["start"]))[0])
    assert accepted[-1][1] < 1.0
    assert accepted[-1][0] < seed
    assert last.startswith("converged")
    assert "every constraint holds" in text(cells["validation"])
    assert result(cells["validation"])["text/plain"] == "True"


@pytest.mark.long
@pytest.mark.timeout(600)
def test_tools_and_grasps(tmp_path: Path) -> None:
    cells = executed("04_tools_and_grasps", tmp_path)

    assert text(cells["attachments"]).startswith(
        "grip: cylindrical, firm True\n  grip_slide: prismatic -0.095 to 0.095\n"
    )
    assert "end: fixed, firm True" in text(cells["attachments"])
    pattern = r"^(take|touch|turn round|quarter turn) +success: stick.grip_slide (\S+), stick.grip_turn (\S+)$"
    grasps = {
        name: (float(slide), float(turn))
        for name, slide, turn in re.findall(pattern, text(cells["grasps"]), re.MULTILINE)
    }
    assert list(grasps) == ["take", "touch", "turn round", "quarter turn"]
    assert all(slide < -0.08 for slide, _ in grasps.values())  # near the butt, as the text says
    assert (
        sum(turn > 0.4 for _, turn in grasps.values()) >= 3
    )  # leaning towards the robot; what follows may speak for another
    assert "iframe" in result(cells["show"])["text/html"]
    moved = re.findall(r"moves by (\S+) while touch with stick.tip", text(cells["firm-check"]))
    assert len(moved) == 2
    assert all(float(value) < 1e-5 for value in moved)
    efforts = dict(
        re.findall(
            r"(grip|end) +success: base [\d.]+ m, arm ([\d.]+) rad", text(cells["worth-numbers"])
        )
    )
    assert float(efforts["grip"]) < float(efforts["end"])
    report = "fetch: success — reach stick.grip, reach ball.pull by stick.tip, place ball, let go"
    assert text(cells["ball"]).startswith(report)
    assert "every constraint holds" in text(cells["ball"])
    rows = re.findall(r"^(\S.*?) +holding (.+)$", text(cells["phases"]), re.MULTILINE)
    assert ("place ball", "stick, ball") in rows
    assert rows[-1] == ("let go", "stick")


@pytest.mark.long
@pytest.mark.timeout(600)
def test_initialization(tmp_path: Path) -> None:
    cells = executed("05_initialization", tmp_path)

    report = text(cells["plan"])
    assert report.startswith("init_3: success — reach stick.grip, touch with stick.tip")
    assert "every constraint holds" in report
    view = result(cells["show"])["text/html"]
    assert "iframe" in view
    assert "init_3" in view
    assert len(view) > 100_000  # the whole film, so that it stays in a saved notebook
    assert min(size(cells["top-view"])) > 300

    grasp = re.findall(
        r"(grip_\w+): ([+-][\d.]+) within \[([-\d.]+), ([-\d.]+)\], moves by (\S+)",
        text(cells["grip"]),
    )
    assert [name for name, *_ in grasp] == ["grip_slide", "grip_turn"]
    for _, value, lower, upper, moved in grasp:
        assert float(lower) - 1e-3 <= float(value) <= float(upper) + 1e-3
        assert float(moved) < 1e-5

    good, number = map(int, re.findall(r"\d+", result(cells["run"])["text/plain"]))
    rows = table(result(cells["table"])["text/markdown"])
    asked = [
        (scene, method)
        for scene in ("init_1", "init_2", "init_3", "all")
        for method in ("interpolated", "astar")
    ]
    assert [(row["scene"], row["method"]) for row in rows] == asked
    counts = {
        (row["scene"], row["method"]): tuple(map(int, row["success"].split(" of "))) for row in rows
    }
    assert all(counts[scene, method][1] == (6 if scene == "all" else 2) for scene, method in asked)
    assert (good, number) == tuple(
        sum(counts["all", method][k] for method in ("interpolated", "astar")) for k in (0, 1)
    )
    assert counts["all", "astar"][0] == 6  # the way around works from everywhere
    assert min(size(cells["chart"])) > 300

    written = {path.name for path in (tmp_path / "few_starts").iterdir()}
    assert written == {"results.csv", "results.json", "success.png", "table.md", "trials.jsonl"}


@pytest.mark.long
@pytest.mark.timeout(600)
def test_baselines(tmp_path: Path) -> None:
    cells = executed("06_baselines", tmp_path)

    assert text(cells["vkc"]).startswith(
        "aisle_drawer: success — reach drawer.handle, move drawer.slide"
    )
    assert "every constraint holds" in text(cells["vkc"])
    assert text(cells["b1"]).startswith("aisle_drawer: ")
    assert "iframe" in result(cells["show"])["text/html"]
    found = re.findall(r"(VKC|B1) +base ([\d.]+) m, arm ([\d.]+) rad", text(cells["efforts"]))
    ways = {
        name: float(base) + 0.158 * float(arm) for name, base, arm in found
    }  # in the metric of what is minimised
    assert ways["VKC"] < ways["B1"]
    assert min(size(cells["joints"])) > 300

    lines = re.findall(r"^(\d) (\w+) ([a-z ]+) base ([\d.]+) m", text(cells["run"]), re.MULTILINE)
    assert sorted((number, method) for number, method, *_ in lines) == [
        ("0", "B1"),
        ("0", "VKC"),
        ("1", "B1"),
        ("1", "VKC"),
    ]
    assert [status for _, method, status, _ in lines if method == "VKC"] == ["success", "success"]
    assert min(size(cells["chart"])) > 300
    written = {path.name for path in (tmp_path / "few_starts").iterdir()}
    assert {"results.csv", "results.json", "table.md", "trials.jsonl", "door.png"} <= written


@pytest.mark.long
@pytest.mark.timeout(600)
def test_chores(tmp_path: Path) -> None:
    cells = executed("07_chores", tmp_path)

    report = text(cells["plan"])
    assert report.startswith(
        "household: success — reach refrigerator.handle, move refrigerator.hinge, reach cold_cup."
    )
    assert "every constraint holds" in report
    assert "iframe" in result(cells["show"])["text/html"]
    rows = re.findall(
        r"^ *([\d.]+) s to +([\d.]+) s  (\w+) .* holding (.*)$",
        text(cells["timetable"]),
        re.MULTILINE,
    )
    assert [(what, holding) for _, _, what, holding in rows if holding != "nothing"] == [
        ("move", "refrigerator"),
        ("place", "cold_cup"),
        ("move", "refrigerator"),
    ]
    assert all(one[1] == other[0] for one, other in itertools.pairwise(rows))
    assert text(cells["error"]).startswith(
        "steps[1].object: the robot has one hand, and it holds cup.side"
    )
    assert "fetch: success — reach stick.grip, reach ball.pull by stick.tip, place ball" in text(
        cells["ten"]
    )
    assert (tmp_path / "fetch.html").stat().st_size > 100_000


@pytest.mark.long
@pytest.mark.timeout(600)
def test_own_robot_and_object(tmp_path: Path) -> None:
    cells = executed("08_own_robot_and_object", tmp_path)

    assert "('base_x', 'base_y', 'base_yaw', 'panda_joint1'" in text(cells["panda"])
    assert "<Robot panda_cart: 7 joints, omni base, tool frame tool>" in text(cells["robot"])
    assert (tmp_path / "mine" / "panda_cart.srdf").is_file()
    assert "'Adjacent': 7" in text(cells["reasons"])
    assert text(cells["other"]).startswith(
        "drawer: success — reach drawer.handle, move drawer.slide"
    )
    assert re.findall(r"^(\w+) +(\w+): base", text(cells["both"]), re.MULTILINE) == [
        ("husky_ur5e", "success"),
        ("panda_cart", "success"),
    ]
    assert text(cells["attachments"]) == "<ArticulatedObject chest: joints hinge>\n"
    assert text(cells["open"]).startswith("room: success — reach chest.bar, move chest.hinge")
    assert "every constraint holds" in text(cells["open"])
    assert "iframe" in result(cells["show"])["text/html"]
    assert text(cells["error"]).startswith(
        "mine/wrong.yaml:5: objects[0].positon: there is no field 'positon'"
    )
    assert "did you mean 'position'" in text(cells["error"])


@pytest.mark.long
@pytest.mark.timeout(600)
def test_when_planning_fails(tmp_path: Path) -> None:
    cells = executed("09_when_planning_fails", tmp_path)

    assert text(cells["typo-error"]).startswith(
        "steps[0].object: there is no object 'drawr'; did you mean 'drawer'?"
    )
    assert text(cells["limit-report"]).startswith("drawer: FAILED, infeasible")
    assert "goal drawer.slide: 0.9 is beyond the limits 0 to 0.4 by 0.5" in text(
        cells["limit-report"]
    )
    assert "closure" in text(cells["limit-report"])

    occupied = text(cells["occupied-report"])
    assert occupied.startswith("drawer: FAILED, infeasible — go to")
    assert (
        "because go to: no place for the base, proven: wherever it would have to be, at any heading, it hits chair"
        in occupied
    )
    page = result(cells["show"])["text/html"]
    assert (
        "clearance: base_link \\u2013 chair" in page or "clearance: base_link – chair" in page
    )  # marked on the time bar
    data = re.findall(r"^(\w+) (.*) ([\d.]+) m at ([\d.]+) s$", text(cells["data"]), re.MULTILINE)
    assert ("clearance", "base_link – chair") in [row[:2] for row in data]

    assert text(cells["wide"]).startswith("drawer: FAILED, infeasible — go to")
    assert re.search(r"base_link – chair are only 4\d\.\d mm apart", text(cells["wide"]))
    assert text(cells["narrow"]).startswith("drawer: success — go to")

    assert re.search(
        r"because reach drawer.handle: (found )?no path for the base", text(cells["fenced"])
    )
    assert text(cells["gap-report"]).startswith(
        "drawer: success — reach drawer.handle, move drawer.slide"
    )

    assert text(cells["time-limit"]).startswith("door: FAILED, time limit")
    assert text(cells["enough-time"]).startswith("door: success")

    before, after = text(cells["validation"]).strip().split("\n\n")
    assert "penetration base_link – parcel: overlap by" in before
    assert after.endswith("every constraint holds")


@pytest.mark.long
@pytest.mark.timeout(600)
def test_from_a_file_to_a_plan(tmp_path: Path) -> None:
    cells = executed("10_from_a_file_to_a_plan", tmp_path)

    assert "arm: arm, 7 joints, 2 fingers" in text(cells["robot"])
    assert "wrote my_panda" in text(cells["robot"])
    (proposal,) = re.findall(r"^  [\d.]+  (\w+) \(bar\)", text(cells["object"]), re.MULTILINE)
    assert min(size(cells["picture"])) > 300
    assert re.search(rf"oven\.{proposal}, approach .*: reached from", text(cells["scene"]))
    report = text(cells["plan"])
    assert report.startswith(f"kitchen: success — reach oven.{proposal}, move oven.microwave")
    assert "every constraint holds" in report
    assert "iframe" in result(cells["show"])["text/html"]
    for made in (
        "my_panda/robot.yaml",
        "my_panda/my_panda.urdf",
        "my_panda/my_panda.srdf",
        "microwave/microroot.yaml",
    ):
        assert (tmp_path / made).is_file()
