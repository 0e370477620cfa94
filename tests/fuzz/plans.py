"""Changes saved plans at random: their metadata, arrays, archive and bytes."""

from __future__ import annotations

import functools
import io
import json
import random
import zipfile
from typing import Any

import numpy as np

import vkc_pin as vkc

from . import odd
from .calls import get_folder, load_drawer_scene, make_plan, make_trajectory
from .mutate import apply_changes, choose_changes

__all__ = ["make_case", "run"]

ARRAYS = ("times", "positions")


@functools.cache
def _make_base() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return metadata and arrays of a plan with all optional parts."""
    terms = [
        vkc.Constraint("elbow", lambda s: s.coordinate("elbow_joint"), lower=-3.0),
        vkc.Cost("x", lambda s: s.position("tool0")[0]),
    ]
    steps: list[Any] = [vkc.Actuate("drawer", {"slide": 0.1}), vkc.GoTo(0.1, 0.1)]
    report = vkc.validate(load_drawer_scene(), steps, make_trajectory(), terms=terms)
    planned = make_plan()
    from vkc_pin.world.task.terms import trace_terms

    plan = vkc.Plan(
        load_drawer_scene(),
        tuple(steps),
        vkc.Options(),
        make_trajectory(),
        report,
        "rejected",
        planned.statistics,
        history=planned.history,
        terms=trace_terms(load_drawer_scene(), terms),
    )
    file = plan.save(get_folder() / "base.npz")
    with np.load(file) as archive:
        return json.loads(str(archive["about"])), {name: archive[name] for name in ARRAYS}


def _write_archive(about: Any, arrays: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=about, **arrays)
    return buffer.getvalue()


def make_case(rng: random.Random) -> dict[str, Any]:
    """Return a case: changes of the metadata, of arrays, of the archive's members, or of bytes."""
    about, _ = _make_base()
    match rng.randrange(8):
        case 0 | 1 | 2 | 3:
            return {"about": choose_changes(rng, about)}
        case 4:
            return {"array": rng.choice((*ARRAYS, "about")), "odd": rng.choice(odd.VALUES)}
        case 5:
            name = rng.choice(("about.npy", "times.npy", "positions.npy"))
            return {
                "member": name,
                "does": rng.choice(
                    ("remove", "double", "empty", "garbage", "liar", "text", "deep")
                ),
            }
        case 6:
            return {"cut": rng.randrange(5000)}
        case _:
            return {
                "bytes": [
                    [rng.randrange(6000), rng.randrange(256)]
                    for _ in range(rng.choice((1, 1, 4, 30)))
                ]
            }


def _make_content(case: dict[str, Any]) -> bytes:
    about, arrays = _make_base()
    if "about" in case:
        return _write_archive(np.array(json.dumps(apply_changes(about, case["about"]))), arrays)
    if "array" in case:
        parts = {"about": np.array(json.dumps(about)), **arrays}
        value = odd.make_value(case["odd"])
        try:
            parts[case["array"]] = np.asarray(value)
            return _write_archive(parts.pop("about"), parts)
        # Not an array, or impossible to pickle
        except (
            ValueError,
            TypeError,
            RuntimeError,
            AttributeError,
            RecursionError,
        ):
            return b""
    data = _write_archive(np.array(json.dumps(about)), arrays)
    if "member" in case:
        return _change_members(data, case["member"], case["does"])
    if "cut" in case:
        return data[: case["cut"]]
    changed = bytearray(data)
    for index, byte in case["bytes"]:
        changed[index % len(changed)] = byte
    return bytes(changed)


def _change_members(data: bytes, name: str, action: str) -> bytes:
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(data)) as old,
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for member in old.namelist():
            content = old.read(member)
            if member == name:
                if action == "remove":
                    continue
                huge_header = (
                    b"\x93NUMPY\x01\x00v\x00"
                    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000,), }".ljust(
                        117
                    )
                    + b"\n"
                )
                nested = io.BytesIO()
                np.save(nested, np.array("[" * 100_000))
                content = {
                    "empty": b"",
                    "garbage": content[::-1],
                    "liar": huge_header,
                    "text": b"{}",
                    "deep": nested.getvalue(),
                }.get(action, content)
            new.writestr(member, content)
            if action == "double" and member == name:
                new.writestr(f"x{member}", content)
    return buffer.getvalue()


def run(case: dict[str, Any]) -> str:
    """Load, print and validate the corrupted plan."""
    file = get_folder() / "spoiled.npz"
    file.write_bytes(_make_content(case))
    plan = vkc.Plan.load(file)
    plan.summary()
    json.dumps(plan.to_dict())
    repr(plan)
    vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options, plan.terms)
    return "loaded"
