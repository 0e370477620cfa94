"""What several test files need and what takes long to make."""

from __future__ import annotations

import gc
import os
import signal
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from helpers.second_opinion import SecondOpinion
from hypothesis import settings

import vkc_pin as vkc

# The same examples every time, so that what passed goes on passing; HYPOTHESIS_PROFILE=random looks
# for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("random", derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

# Nothing is compiled in the background and nothing is written to the user's home; tests of that
# name folders of their own.
os.environ["VKC_PIN_CACHE"] = "off"

# A shell that runs the tests in the background lets them ignore Ctrl-C, which some of them press.
signal.signal(signal.SIGINT, signal.default_int_handler)


# Every motion that succeeds in a test is judged by the oracle as well, before the test is over.
OPINION = SecondOpinion()
OPINION.attach()
OPINIONS: dict[str, dict[str, Any]] = {}  # of the processes that tests run in


def pytest_collection_finish() -> None:
    """Exclude tests and modules, which stay until the end, from garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def second_opinion(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[None]:
    """Fail the test if the oracle contradicts a plan that its planner called successful."""
    yield
    if request.node.get_closest_marker("made_up"):
        OPINION.forget()
    if wrong := OPINION.verdicts(tmp_path_factory.getbasetemp()):
        pytest.fail(
            "\n".join(f"{verdict.path}: {found}" for verdict in wrong for found in verdict.found),
            pytrace=False,
        )


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Say what was judged; with pytest-xdist, to the process that the others work for."""
    counts = {name: value for name, value in vars(OPINION).items() if not name.startswith("_")}
    output: dict[str, Any] = getattr(session.config, "workeroutput", OPINIONS)
    output["second opinion"] = counts


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take what a process of pytest-xdist says at its end."""
    if "second opinion" in getattr(node, "workeroutput", {}):
        OPINIONS[node.gateway.id] = node.workeroutput["second opinion"]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say how much the oracle has judged, and what it could not."""
    planned, judged, seconds = (
        sum(counts[name] for counts in OPINIONS.values())
        for name in ("planned", "judged", "seconds")
    )
    terminalreporter.write_line(
        f"oracle: {planned} motions planned, {judged} different ones judged in {seconds:.1f} s"
    )
    for reason, count in Counter(
        reason for counts in OPINIONS.values() for reason in counts["unjudged"]
    ).items():
        terminalreporter.write_line(f"oracle: {count} not judged: {reason}")


@pytest.fixture(scope="session")
def door_plan() -> vkc.Plan:
    """Return a plan that drives up to the door, turns its knob and pushes it open to 1.2 rad."""
    scene = vkc.load_scene("door").with_start(base=[-0.03, 0.09, -1.19])
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})])
    assert plan.success, plan.summary()
    return plan
