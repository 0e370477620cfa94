"""What a notebook's user does, in a real kernel: show, look at the value of a cell, watch the progress, interrupt."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from helpers.kernel import Kernel, kernel

DOOR = """
scene = vkc.load_scene("door").with_start(base=[-0.03, 0.09, -1.19])
steps = [vkc.Actuate("door", {"hinge": 1.2})]
"""
TELL = "print(plan.status, plan.success, len(plan.report.violations), len(plan.summary()) > 100, flush=True)"
TOLD = r"interrupted False [1-9]\d* True\n"


@pytest.fixture(scope="module")
def jupyter() -> Iterator[Kernel]:
    with kernel() as started:
        started.run(DOOR)
        yield started


def printed(outputs: list[dict[str, Any]]) -> str:
    assert not [output for output in outputs if output["kind"] == "error"], outputs
    return "".join(
        output["text"]
        for output in outputs
        if output["kind"] == "stream" and output["name"] == "stdout"
    )


def test_show_is_part_of_the_notebook(jupyter: Kernel) -> None:
    (output,) = jupyter.run("from helpers.fake_plan import fake_plan\nfake_plan().show()")
    page = output["data"]["text/html"]
    assert "iframe srcdoc=" in page
    assert 500_000 < len(page) < 5_000_000
    assert not re.search(r"""\bsrc=["']?http""", page)


def test_the_value_of_a_cell_is_an_overview(jupyter: Kernel) -> None:
    jupyter.run(
        "from vkc_pin.planning.results import joined\nfrom vkc_pin.planning.request import Settings"
    )
    jupyter.run("plan = joined(scene, steps, Settings('auto', vkc.Options()), [])")
    for code, text in (("plan", "FAILED, interrupted"), ("scene", "obstacles")):
        (output,) = jupyter.run(code)
        page = output["data"]["text/html"]
        assert text in page
        assert "data:image/png;base64," in page
        assert len(page) < 60_000
        assert "text/plain" in output["data"]


def test_progress_is_one_line_that_is_written_over(jupyter: Kernel) -> None:
    outputs = jupyter.run("plan = vkc.plan(scene, steps, progress=True)")
    assert {output["name"] for output in outputs} == {"stdout"}, outputs
    *before, last = printed(outputs).split("\r")
    assert len(before) > 3
    assert not any("\n" in text for text in before)
    assert re.fullmatch(r"door: success — base .* m, arm .* rad, planned in [\d.]+ s *\n", last)
    assert jupyter.run("plan = vkc.plan(scene, steps)") == []


@pytest.mark.parametrize(
    ("where", "code"),
    [
        ("seeds", "vkc_pin.planning.initialization.methods._GuessSearch, '_search'"),
        ("solver", "vkc_pin.planning.solver.subproblem.Subproblem, 'solve'"),
        ("validation", "vkc_pin.planning.solve_task, 'validate'"),
        ("building", "vkc_pin.planning.solve_task, 'TrajectoryProblem'"),
    ],
)
def test_an_interrupted_cell_leaves_a_plan(jupyter: Kernel, where: str, code: str) -> None:
    """The kernel is interrupted once planning has come to a place where it stays for a while."""
    slow = f"""
import time, importlib
import vkc_pin.planning.initialization.methods, vkc_pin.planning.solver.loop, vkc_pin.planning.solve_task
owner, name = {code}
original = getattr(owner, name)
def slow(*arguments, **options):
    print("now", flush=True)
    end = time.perf_counter() + 2.0
    while time.perf_counter() < end:
        time.sleep(0.01)
    return original(*arguments, **options)
setattr(owner, name, slow)
try:
    initialization = "auto" if {where!r} == "seeds" else "stationary"
    plan = vkc.plan(scene, steps, options=vkc.Options(max_outer=2), initialization=initialization, progress=True)
finally:
    setattr(owner, name, original)
"""
    outputs = jupyter.run(slow, interrupt="now", delay=0.3)
    assert "FAILED, interrupted" in printed(outputs).split("\r")[-1]
    assert re.fullmatch(TOLD, printed(jupyter.run(TELL)))
    (view,) = jupyter.run("plan.show()")
    assert "FAILED, interrupted" in view["data"]["text/html"]
    (value,) = jupyter.run("plan")
    assert "FAILED, interrupted" in value["data"]["text/html"]
    assert printed(jupyter.run("print(vkc.plan(scene, steps).status)")) == "success\n", (
        "the next one is as if nothing had been"
    )
