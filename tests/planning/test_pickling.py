"""Tests copies of errors, scenes and plans, and their transfer to process pools."""

from __future__ import annotations

import copy
import functools
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.datasets.problems import NoProblemError
from vkc_pin.errors import BuildError, InputError, UnknownNameError, VkcError
from vkc_pin.utils.budget import BudgetExhaustedError

COPY_METHODS = {
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "protocol 2": lambda value: pickle.loads(pickle.dumps(value, 2)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    "dask": lambda value: pickle.loads(pytest.importorskip("cloudpickle").dumps(value)),
}


@pytest.mark.parametrize(
    "error",
    [
        BuildError("no compiler"),
        NoProblemError("no free start"),
        BudgetExhaustedError("time limit"),
        InputError("wrong", file=Path("a.yaml"), line=3, field="size", expected="1", got=2.5),
        InputError("wrong", expected=(item for item in ()), got=lambda: None),
        UnknownNameError("link", "wrst", ["base", "wrist"], file="r.yaml", line=2, field="tool"),
        UnknownNameError("link", "wrst", []),
    ],
    ids=range(7),
)
@pytest.mark.parametrize("method", COPY_METHODS)
def test_copied_errors_keep_their_text_and_details(method: str, error: VkcError) -> None:
    copied = COPY_METHODS[method](error)
    assert type(copied) is type(error)
    assert (str(copied), copied.args) == (str(error), error.args)
    assert vars(copied).keys() == vars(error).keys()
    comparable = vars(error).keys() - {"expected", "got"}
    assert all(vars(copied)[key] == vars(error)[key] for key in comparable)


def test_process_pool_raises_the_errors_of_its_workers() -> None:
    with get_context("spawn").Pool(1) as pool, pytest.raises(UnknownNameError, match="'doors'"):
        pool.apply_async(vkc.load_scene, ("doors",)).get(timeout=60)


STEPS = [vkc.Actuate("door", {"hinge": 0.3})]


@functools.cache
def make_plan() -> vkc.Plan:
    return vkc.plan(vkc.load_scene("door"), STEPS)


def assert_same_motion(one: vkc.Plan, other: vkc.Plan) -> None:
    assert other.success
    np.testing.assert_array_equal(other.trajectory.times, one.trajectory.times)
    np.testing.assert_array_equal(other.trajectory.positions, one.trajectory.positions)
    assert repr(other.report) == repr(one.report)


def test_process_pool_plans_the_same_motion() -> None:
    plan = make_plan()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        returned = pool.submit(vkc.plan, plan.scene, STEPS).result(timeout=120)
        checked = pool.submit(vkc.validate, plan.scene, plan.steps, plan.trajectory)
        report = checked.result(timeout=120)
    assert_same_motion(plan, returned)
    again = vkc.validate(returned.scene, returned.steps, returned.trajectory)
    assert repr(again) == repr(report) == repr(plan.report)


@pytest.mark.parametrize("method", COPY_METHODS)
def test_copied_scenes_and_plans_give_the_same_motions_and_reports(method: str) -> None:
    plan, copied = make_plan(), COPY_METHODS[method](make_plan())
    assert copied.scene.document == plan.scene.document
    assert_same_motion(plan, copied)
    scene = COPY_METHODS[method](plan.scene)
    assert repr(vkc.validate(scene, STEPS, copied.trajectory)) == repr(plan.report)
    assert_same_motion(plan, vkc.plan(scene, STEPS))


@pytest.mark.parametrize("method", COPY_METHODS)
@pytest.mark.parametrize("name", ["household", "gap_table"])
def test_copied_scenes_have_the_same_shapes_and_stay_read_only(name: str, method: str) -> None:
    scene = vkc.load_scene(name)
    copied: Any = COPY_METHODS[method](scene)
    assert copied.start_clearance() == scene.start_clearance()
    assert repr(copied) == repr(scene)
    assert list(copied.objects) == list(scene.objects)
    with pytest.raises(TypeError):
        copied.objects["new"] = None
    for key, placed in scene.objects.items():
        same = COPY_METHODS[method](placed).object
        assert list(same.attachments) == list(placed.object.attachments)
        assert same.name == copied.objects[key].object.name
    robot = COPY_METHODS[method](scene.robot)
    np.testing.assert_array_equal(robot.home, scene.robot.home)
    assert robot.model == scene.robot.model
