"""Configures the tests, lets the oracle judge their plans, and provides shared fixtures."""

from __future__ import annotations

import gc
import os
import signal
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from helpers.second_opinion import PlanJudge
from hypothesis import settings

import vkc_pin as vkc

# Examples are reproducible; HYPOTHESIS_PROFILE=random generates new ones, =long many new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("random", derandomize=False)
settings.register_profile("long", derandomize=False, max_examples=20_000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

# Disables background compilation and the cache in the user's home. Tests of the cache set their own
# folders.
os.environ["VKC_PIN_CACHE"] = "off"

# Background processes of a shell ignore SIGINT, which some tests send.
signal.signal(signal.SIGINT, signal.default_int_handler)


# The oracle judges every successful plan of a test before the test ends.
JUDGE = PlanJudge()
JUDGE.attach()
COUNTS: dict[str, dict[str, Any]] = {}  # counts by test process


def pytest_collection_finish() -> None:
    """Exclude tests and modules, which live until the end, from garbage collection."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def second_opinion(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[None]:
    """Fail the test if the oracle contradicts a plan that its planner called successful."""
    yield
    if request.node.get_closest_marker("made_up"):
        JUDGE.drop_plans()
    if verdicts := JUDGE.verdicts(tmp_path_factory.getbasetemp()):
        pytest.fail(
            "\n".join(
                f"{verdict.path}: {found}" for verdict in verdicts for found in verdict.found
            ),
            pytrace=False,
        )


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Store the counts of the oracle; with pytest-xdist, send them to the main process."""
    counts = {name: value for name, value in vars(JUDGE).items() if not name.startswith("_")}
    output: dict[str, Any] = getattr(session.config, "workeroutput", COUNTS)
    output["second opinion"] = counts


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Store the counts of a pytest-xdist process that ends."""
    if "second opinion" in getattr(node, "workeroutput", {}):
        COUNTS[node.gateway.id] = node.workeroutput["second opinion"]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the number of judged plans, and the reasons for unjudged ones."""
    planned, judged, seconds = (
        sum(counts[name] for counts in COUNTS.values()) for name in ("planned", "judged", "seconds")
    )
    terminalreporter.write_line(
        f"oracle: {planned} motions planned, {judged} different ones judged in {seconds:.1f} s"
    )
    for reason, count in Counter(
        reason for counts in COUNTS.values() for reason in counts["unjudged"]
    ).items():
        terminalreporter.write_line(f"oracle: {count} not judged: {reason}")


@pytest.fixture(scope="session")
def door_plan() -> vkc.Plan:
    """Return a plan that drives up to the door, turns its knob and pushes it open to 1.2 rad."""
    scene = vkc.load_scene("door").with_start(base=[-0.03, 0.09, -1.19])
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})])
    assert plan.success, plan.summary()
    return plan
