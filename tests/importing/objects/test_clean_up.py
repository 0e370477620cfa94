from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.descriptions import make_description, make_joint, make_part, make_placement
from helpers.partnet import write_partnet_object
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from vkc_pin.importing.description import Description, Link
from vkc_pin.importing.objects.clean_up import (
    choose_name,
    compute_bounds,
    find_multiple_objects,
    load_surfaces,
    make_upright,
    merge_fixed_links,
    scale_object,
)
from vkc_pin.importing.objects.object_reading import read_object
from vkc_pin.world.files.fields import Name


@pytest.fixture
def cabinet(tmp_path: Path) -> Description:
    return read_object(write_partnet_object(tmp_path))


def compute_box(description: Description, **values: float) -> np.ndarray:
    return np.array(compute_bounds(description, load_surfaces(description), values))


def test_fixed_links_are_merged(cabinet: Description) -> None:
    found = merge_fixed_links(cabinet)
    assert set(found.links) == {"base", "link_0", "link_1"}
    assert found.joints["link_0"].parent == "base"
    assert any("joint_3" in note and "no" in note for note in found.notes)
    assert np.allclose(compute_box(cabinet), compute_box(found))
    assert "link_2_frame-1" in [part.name for part in found.links["base"].visual]


@settings(max_examples=5, deadline=None)
@given(factor=st.floats(0.1, 10.0), slide=st.floats(0.0, 0.36))
def test_scaling_scales_shapes_and_limits(
    factor: float, slide: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    cabinet = read_object(write_partnet_object(tmp_path_factory.mktemp("p") / "x"))
    large = scale_object(cabinet, factor)
    one = compute_box(cabinet, joint_0=slide)
    other = compute_box(large, joint_0=factor * slide)
    assert np.allclose(factor * one, other, rtol=1e-9, atol=1e-9)
    assert large.joints["link_0"].limits == pytest.approx((0.0, factor * 0.36))


def test_inertia_is_merged_scaled_and_rotated() -> None:
    """A handle is fixed to a door, and a flap with equal limits to the handle."""
    place = make_placement((0.0, 0.5, 0.0))
    inertia = pin.Inertia(2.0, np.array([0.1, 0.2, 0.3]), np.diag([0.1, 0.2, 0.25]))
    joints = [
        make_joint("case", "door", at=place),
        make_joint("door", "handle", "fixed", at=place),
        make_joint("handle", "flap", at=place, limits=(0.3, 0.3)),
    ]
    links = [Link(name, (), (make_part(),), inertia) for name in ("case", "door", "handle", "flap")]
    merged = merge_fixed_links(make_description(links, joints))
    assert set(merged.links) == {"case", "door"}
    door = merged.links["door"]
    flap = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.0, 0.0), np.array([0.0, 1.0, 0.0]))
    assert [part.name for part in door.collision] == ["", "handle", "flap"]
    assert np.allclose(door.collision[2].placement.homogeneous, flap.homogeneous)
    assert door.inertia.isApprox(inertia + place.act(inertia) + flap.act(inertia))
    assert any("to_flap" in note for note in merged.notes)
    single = make_description([Link("a", inertia=inertia)])
    large = scale_object(single, 3.0).links["a"].inertia
    assert large.isApprox(pin.Inertia(2.0, 3.0 * inertia.lever, 9.0 * inertia.inertia))
    rotated = make_upright(single, "y").links["a"].inertia
    assert np.allclose(rotated.lever, [0.1, -0.3, 0.2])
    assert not single.is_massless


def test_long_chains_of_fixed_links_are_merged() -> None:
    """A hinge connects the last of 1500 links, followed by two links without shapes."""
    count = 1500
    joints = [
        make_joint(
            f"l{k - 1}", f"l{k}", "fixed" if k < count - 1 else "revolute", at=(0.01, 0.0, 0.0)
        )
        for k in range(1, count + 2)
    ]
    links = [Link(f"l{k}", (), (make_part(),) * (k < count)) for k in range(count + 2)]
    merged = merge_fixed_links(make_description(links, joints))
    assert list(merged.links) == ["l0", f"l{count - 1}"]
    (hinge,) = merged.joints.values()
    assert hinge.parent == "l0"
    assert hinge.placement.translation == pytest.approx([0.01 * (count - 1), 0.0, 0.0])
    assert len(merged.links["l0"].collision) == count - 1
    assert ["moves no shape" in note for note in merged.notes] == [True] * 2


@pytest.mark.parametrize(
    ("objects", "solid", "note"),
    [
        # Each object: kinds of its own joint and of those on it
        (
            [("fixed", "revolute"), ("fixed", "revolute", "prismatic")],
            False,
            "'a' (1 joint), 'b' (2 joints)",
        ),
        ([("fixed", "revolute"), ("fixed", "revolute")], True, ""),
        ([("fixed", "revolute")], False, ""),
        ([("fixed", "revolute"), ("fixed",)], False, ""),
        ([("prismatic",), ("prismatic",)], False, ""),
    ],
    ids=["two", "two on a body", "one", "one and a wall", "chest of drawers"],
)
def test_separate_objects_in_one_file_are_noted(
    objects: list[tuple[str, ...]], solid: bool, note: str
) -> None:
    links, joints = [Link("world", (), (make_part(),) * solid)], []
    for name, (own, *kinds) in zip("ab", objects, strict=False):
        ends = [("world", name), *((name, f"{name}{k}") for k in range(len(kinds)))]
        links += [Link(child, (), (make_part(),)) for _, child in ends]
        joints += [make_joint(*end, kind) for end, kind in zip(ends, (own, *kinds), strict=True)]
    notes = find_multiple_objects(make_description(links, joints))
    assert len(notes) == bool(note)
    assert note in "".join(notes)


@given(st.lists(st.text(max_size=5), max_size=8))
def test_chosen_names_are_valid_and_distinct(wanted: list[str]) -> None:
    taken = set[str]()
    names = [choose_name(name, taken) for name in wanted]
    assert len(set(names)) == len(names)
    assert taken == set(names)
    for name in names:
        TypeAdapter(Name).validate_python(name)


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("box", (0.1, 0.2, 0.3), 0.006),
        ("sphere", (0.1,), 4.0 / 3.0 * np.pi * 1e-3),
        ("cylinder", (0.1, 0.2), np.pi * 2e-3),
        ("capsule", (0.1, 0.2), np.pi * 2e-3 + 4.0 / 3.0 * np.pi * 1e-3),
    ],
)
def test_part_meshes_have_volume_and_placement(
    kind: str, size: tuple[float, ...], volume: float
) -> None:
    mesh = make_part(kind, size, (1.0, 2.0, 3.0)).make_mesh()
    assert mesh.volume == pytest.approx(volume, rel=0.02)
    assert np.allclose(mesh.bounds.mean(axis=0), [1.0, 2.0, 3.0], atol=1e-6)


def test_placements_follow_the_joints() -> None:
    ahead, up = (1.0, 0.0, 0.0), np.array([0.0, 0.0, 1.0])
    joints = [
        make_joint("b", "c", "prismatic", ahead, axis=up),
        make_joint("a", "b", "revolute", ahead, axis=up),
    ]
    found = make_description([Link(name) for name in "abc"], joints)
    assert found.root == "a"
    placements = found.compute_placements({"to_b": np.pi / 2, "to_c": 0.3})
    assert np.allclose(placements["c"].translation, [1.0, 1.0, 0.3])
    assert found.subtree("b") == {"b", "c"}
