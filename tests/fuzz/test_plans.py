"""Tests saved plans with changed metadata, arrays, archives and bytes."""

from __future__ import annotations

import functools
import io
import json
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from fuzz.bounds import expect_result_or_error, take_share
from fuzz.calls import get_folder, load_drawer_scene, make_plan, make_trajectory
from fuzz.changes import change_bytes, change_data
from fuzz.values import VALUES
from vkc_pin.world.task.terms import trace_terms

MEMBERS = ("about.npy", "times.npy", "positions.npy")
HUGE_SHAPE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000,), }".ljust(117)


@functools.cache
def save_base() -> bytes:
    """Return a saved plan with all optional parts."""
    scene = load_drawer_scene()
    terms = [
        vkc.Constraint("elbow", lambda s: s.coordinate("elbow_joint"), lower=-3.0),
        vkc.Cost("x", lambda s: s.position("tool0")[0]),
    ]
    steps = (vkc.Actuate("drawer", {"slide": 0.1}), vkc.GoTo(0.1, 0.1))
    report = vkc.validate(scene, steps, make_trajectory(), terms=terms)
    planned = make_plan()
    plan = vkc.Plan(
        scene,
        steps,
        vkc.Options(),
        make_trajectory(),
        report,
        "rejected",
        planned.statistics,
        history=planned.history,
        terms=trace_terms(scene, terms),
    )
    return plan.save(get_folder() / "base.npz").read_bytes()


@functools.cache
def read_arrays() -> dict[str, Any]:
    """Return the arrays of the saved plan."""
    with np.load(io.BytesIO(save_base())) as archive:
        return dict(archive)


def write_array(values: Any) -> bytes:
    """Return a member of the archive, empty if the values cannot be written."""
    buffer = io.BytesIO()
    try:
        np.save(buffer, np.asarray(values))
    except Exception:  # objects of all kinds, some of which raise errors on every use
        return b""
    return buffer.getvalue()


@st.composite
def changed_members(draw: st.DrawFn) -> bytes:
    """Return an archive with one member changed, removed or doubled."""
    chosen = draw(st.sampled_from(MEMBERS))
    values = VALUES.map(write_array) | st.sampled_from(
        (b"", b"{}", b"\x93NUMPY\x01\x00v\x00" + HUGE_SHAPE + b"\n", write_array("[" * 100_000))
    )
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(save_base())) as old,
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            content = old.read(name)
            copies = {name: content}
            if name == chosen:
                changed = draw(values)
                copies = draw(
                    st.sampled_from(({name: changed}, {}, {**copies, f"x{name}": content}))
                )
            for each, data in copies.items():
                new.writestr(each, data)
    return buffer.getvalue()


@st.composite
def changed_plans(draw: st.DrawFn) -> bytes:
    """Return an archive with changed metadata."""
    arrays = read_arrays()
    about = draw(change_data(json.loads(str(arrays["about"]))))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{**arrays, "about": np.array(json.dumps(about))})
    return buffer.getvalue()


def load_plan(content: bytes) -> None:
    """Load, print and validate a plan."""
    file = get_folder() / "changed.npz"
    file.write_bytes(content)
    plan = vkc.Plan.load(file)
    plan.summary()
    json.dumps(plan.to_dict())
    repr(plan)
    vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options, plan.terms)


@take_share(0.1)
@given(
    st.one_of(
        changed_plans(),
        changed_plans(),
        changed_members(),
        st.deferred(lambda: change_bytes(save_base())),
    )
)
def test_changed_plans_yield_a_plan_or_an_error(content: bytes) -> None:
    with expect_result_or_error():
        load_plan(content)


@pytest.mark.long
def test_unchanged_plan_is_loaded() -> None:
    load_plan(save_base())
