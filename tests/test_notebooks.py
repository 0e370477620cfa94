"""Tests that every notebook runs and that its cells show the expected output."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import vkc_pin as vkc

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
VALID = "every constraint holds"
PICTURE, VIEW = "picture", "view"
KINDS = {
    VIEW: {"show"},
    PICTURE: {"plot", "spy", "along", "convergence", "top-view", "chart", "joints", "picture"},
}
"""Kind of output → cells that have it in every notebook."""
DOOR = r"^door: success — reach door.handle, turn door.knob, move door.hinge, door.knob"
DRAWER = r"drawer: success — reach drawer.handle, move drawer.slide"

# Cell id -> regular expressions that its output matches.
EXPECTED: dict[str, dict[str, tuple[str, ...]]] = {
    "01_first_plan": {
        "scene": ("husky_ur5e",),
        "plan": (DOOR, VALID),
        "overview": ("<table", "data:image/png"),
        "arrays": ("^times .* positions ",),
        "files": ("wrist_3_joint", r"\d+ points"),
        "again": ("True.*True.*True",),
    },
    "02_virtual_kinematic_chain": {
        "urdf": (r"hinge +universe .*-1.57 +1.57\n", r"knob +hinge .*0.00 +0.80\n"),
        "inverted": (r"knob +universe +RZ", r"hinge +knob +RZ"),
        "chain": (r"base +universe +Planar", r"door.hinge .*-1.57 +1.57\n11 +coordinates:"),
        "same": (r"e-1[2-9]",),
        "plan": ("^success",),
        "compare": (r"wrist_3_link +0.0+ mm", r"tool +0.0+ mm", r"door.lever +0\.\d+ mm"),
        "axes": (r"-1.0\d*\n.*-1.0",),
    },
    "03_optimisation_problem": {
        "build": (r"\d+ steps", r"\d+ variables", r"\d+ rows"),
        "sizes": ("rows: closure door",),
        "start": (r"guess: [1-9]\d* violations",),
        "solve": (r"accepted\n", r"\nconverged"),
        "validation": (VALID, "True"),
    },
    "04_tools_and_grasps": {
        "attachments": (r"^grip: cylindrical, firm True\n  grip_slide: prismatic", "end: fixed"),
        "grasps": (r"take +success", r"touch +success", r"turn round +success"),
        "firm-check": (r"grip_turn moves by (0e\+00|\de-\d\d) while touch with stick.tip",),
        "worth-numbers": (r"grip +success", r"end +success"),
        "ball": (
            "^fetch: success — reach stick.grip, reach ball.pull by stick.tip, place ball, let go",
            VALID,
        ),
        "phases": (r"place ball +holding stick, ball", r"let go +holding stick"),
    },
    "05_initialization": {
        "plan": ("^init_3: success — reach stick.grip, touch with stick.tip", VALID),
        "show": ("init_3",),
        "grip": ("grip_slide: ", "grip_turn: "),
        "table": (r"\| all \| astar \| 6 of 6 \|",),
    },
    "06_baselines": {
        "vkc": ("^aisle_drawer: success — reach drawer.handle, move drawer.slide", VALID),
        "b1": ("^aisle_drawer: ",),
        "run": ("0 VKC success", "1 VKC success", "0 B1 ", "1 B1 "),
    },
    "07_chores": {
        "plan": ("^household: success — reach refrigerator.handle, move refrigerator.hinge", VALID),
        "timetable": ("holding refrigerator", "place .* holding cold_cup"),
        "error": (r"^steps\[1\].object: the robot has one hand, and it holds cup.side",),
        "ten": ("fetch: success — reach stick.grip, reach ball.pull by stick.tip, place ball",),
    },
    "08_own_robot_and_object": {
        "panda": (r"\('base_x', 'base_y', 'base_yaw', 'panda_joint1'",),
        "robot": ("<Robot panda_cart: 7 joints, omni base, tool frame tool>",),
        "reasons": ("'Adjacent': 7",),
        "other": (f"^{DRAWER}",),
        "both": (r"husky_ur5e +success", r"panda_cart +success"),
        "open": ("^room: success — reach chest.bar, move chest.hinge", VALID),
        "error": (r"^mine/wrong.yaml:5: objects\[0\].positon: .*did you mean 'position'",),
    },
    "09_when_planning_fails": {
        "typo-error": (r"^steps\[0\].object: there is no object 'drawr'; did you mean 'drawer'",),
        "limit-report": (
            "^drawer: FAILED, infeasible",
            "goal drawer.slide: 0.9 m is beyond the limits 0 to 0.4 m by 0.5 m",
        ),
        "occupied-report": ("^drawer: FAILED, infeasible", "hits chair"),
        "data": ("clearance base_link – chair",),
        "wide": ("^drawer: FAILED, infeasible", "base_link – chair are only"),
        "narrow": ("^drawer: success",),
        "fenced": ("because reach drawer.handle: (found )?no path for the base",),
        "gap-report": (f"^{DRAWER}",),
        "time-limit": ("^door: FAILED, time limit",),
        "enough-time": ("^door: success",),
        "validation": (f"penetration base_link – parcel: overlap by(.|\n)*{VALID}$",),
    },
    "10_from_a_file_to_a_plan": {
        "robot": ("arm: arm, 7 joints, 2 fingers", "wrote my_panda"),
        "object": (r"\n  [\d.]+  \w+ \(bar\)",),
        "scene": (r"oven\.\w+, approach .*: reached from",),
        "plan": (r"^kitchen: success — reach oven.\w+, move oven.microwave", VALID),
    },
    "11_problems_of_others": {
        "problem": ("panda, objects none, 7 obstacles",),
        "plan": ("^shelf_scene0065: success — configure", VALID),
        "pose": ("^shelf_scene0065: success — reach with panda_hand_tcp", VALID),
        "driving": ("joint values +success", "pose +success", r"driving +success: base [0-9.]+ m"),
    },
    "12_closed_loop": {
        "rest": ("^door: success — reach door.handle", r"largest jump of a velocity: \d\.\de-1\d"),
        "stop": (r"(at \d.0 s: success, at rest after 0\.\d\d s\n){3}",),
        "loop": (r"^<ExecutionResult success", "replan .*door is elsewhere"),
        "person": (r"^<ExecutionResult success", r"(replan|brake) .*stool"),
    },
    "13_from_a_cloud_to_a_drawer": {
        "scene": ("success — reach drawer.handle, move drawer.slide",),
        "cloud": (r"^1\d{5} points",),
        "known": (r"'points': PointCounts\(kept=\d+", "the blind motion is free: False"),
        "plan": ("success — reach drawer.handle, move drawer.slide", VALID),
        "truth": ("^True",),
    },
}


def execute(name: str, folder: Path) -> dict[str, nbformat.NotebookNode]:
    """Run a notebook in `folder`, save it for the site, and return its cells by id."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    (ROOT / "out" / "notebooks").mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, ROOT / "out" / "notebooks" / f"{name}.ipynb")
    return {cell.id: cell for cell in notebook.cells}


def read_output(cell: nbformat.NotebookNode) -> str:
    """Return the printed output of a cell and the text of its value."""
    parts = []
    for output in cell.outputs:
        if output.output_type == "stream" and output.name == "stdout":
            parts.append(output.text)
        elif output.output_type == "execute_result":
            data = output.data
            parts += [
                data[kind] for kind in ("text/markdown", "text/html", "text/plain") if kind in data
            ]
    return "".join(parts).rstrip("\n") + "\n"


def read_picture_size(cell: nbformat.NotebookNode) -> tuple[int, int]:
    """Return width and height of the PNG in a cell's output [pixels]."""
    (data,) = (out.data for out in cell.outputs if "image/png" in out.get("data", {}))
    png = base64.b64decode(data["image/png"])
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    return int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stored_without_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in notebook.cells:
        assert not cell.metadata, cell.id
        if cell.cell_type == "code":
            assert (cell.outputs, cell.execution_count) == ([], None), cell.id


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", [path.stem for path in NOTEBOOKS])
def test_notebook_runs_and_its_cells_show_the_expected_output(name: str, tmp_path: Path) -> None:
    cells = execute(name, tmp_path)
    kinds = [(cell, (kind,)) for kind, ids in KINDS.items() for cell in ids & cells.keys()]
    for cell, patterns in [*kinds, *EXPECTED[name].items()]:
        shown = read_output(cells[cell])
        for pattern in patterns:
            if pattern == PICTURE:
                assert min(read_picture_size(cells[cell])) > 200, cell
            elif pattern == VIEW:
                assert "iframe" in shown, cell
                assert len(shown) > 100_000, cell  # the whole animation
            else:
                assert re.search(pattern, shown), (cell, pattern, shown[:2000])
    if name == "01_first_plan":
        plan = vkc.Plan.load(tmp_path / "door.npz")
        steps = [vkc.Actuate("door", {"hinge": 1.2})]
        assert vkc.validate(vkc.load_scene("door"), steps, plan.trajectory).ok
        assert plan.trajectory.column("door.hinge")[-1] == pytest.approx(1.2, abs=1e-3)


def test_equations_agree_with_the_documentation() -> None:
    page = (ROOT / "docs" / "formulation.md").read_text(encoding="utf-8")
    notebook = nbformat.read(ROOT / "notebooks" / "03_optimisation_problem.ipynb", as_version=4)
    (source,) = (cell.source for cell in notebook.cells if cell.id == "equations")
    stated, shown = (re.findall(r"^(.*)&& (\(\d\))", text, re.MULTILINE) for text in (page, source))
    assert [number for _, number in stated] == [f"({k})" for k in range(1, 8)]
    assert shown == stated
