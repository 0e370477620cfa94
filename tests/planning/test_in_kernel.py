"""Tests plans, progress and interrupts in a real Jupyter kernel."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from helpers.kernel import Kernel, start_kernel

DRAWER = """
scene = vkc.load_scene("drawer")
steps = [vkc.Actuate("drawer", {"slide": 0.3})]
"""
PRINT_STATUS = (
    "print(plan.status, plan.success, len(plan.report.violations), len(plan.summary()) > 100)"
)
INTERRUPTED_STATUS = r"interrupted False [1-9]\d* True\n"


@pytest.fixture(scope="module")
def jupyter() -> Iterator[Kernel]:
    with start_kernel() as kernel:
        kernel.run(DRAWER)
        yield kernel


def get_output(outputs: list[dict[str, Any]]) -> str:
    assert not [output for output in outputs if output["kind"] == "error"], outputs
    return "".join(
        output["text"]
        for output in outputs
        if output["kind"] == "stream" and output["name"] == "stdout"
    )


def test_show_embeds_its_page_in_the_notebook(jupyter: Kernel) -> None:
    (output,) = jupyter.run("from helpers.fake_plan import make_fake_plan\nmake_fake_plan().show()")
    page = output["data"]["text/html"]
    assert "iframe srcdoc=" in page
    assert 500_000 < len(page) < 5_000_000
    assert not re.search(r"""\bsrc=["']?http""", page)


def test_cell_displays_an_overview_of_its_value(jupyter: Kernel) -> None:
    jupyter.run("plan = vkc.plan(scene, steps, time_limit=1e-6)")
    for code, text in (("plan", "FAILED, time limit"), ("scene", "obstacles")):
        (output,) = jupyter.run(code)
        page = output["data"]["text/html"]
        assert text in page
        assert "data:image/png;base64," in page
        assert len(page) < 60_000
        assert "text/plain" in output["data"]


def test_progress_is_one_line(jupyter: Kernel) -> None:
    outputs = jupyter.run("plan = vkc.plan(scene, steps, progress=True)")
    assert {output["name"] for output in outputs} == {"stdout"}, outputs
    *before, last = get_output(outputs).split("\r")
    assert len(before) > 3
    assert not any("\n" in text for text in before)
    assert re.fullmatch(r"drawer: success — base .* m, arm .* rad, planned in [\d.]+ s *\n", last)
    assert jupyter.run("plan = vkc.plan(scene, steps)") == []


@pytest.mark.long
def test_interrupted_cell_returns_a_plan(jupyter: Kernel) -> None:
    """The callback waits, so that the interrupt arrives during planning."""
    code = """
import time
def wait(row):
    print("now", flush=True)
    time.sleep(2.0)
plan = vkc.plan(scene, steps, initialization="stationary", callback=wait, progress=True)
"""
    outputs = jupyter.run(code, interrupt="now", delay=0.3)
    assert "FAILED, interrupted" in get_output(outputs).split("\r")[-1]
    assert re.fullmatch(INTERRUPTED_STATUS, get_output(jupyter.run(PRINT_STATUS)))
    (value,) = jupyter.run("plan")
    assert "FAILED, interrupted" in value["data"]["text/html"]
    assert get_output(jupyter.run("print(vkc.plan(scene, steps).status)")) == "success\n"
