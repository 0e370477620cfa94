from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.partnet import write_partnet_object
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from vkc_pin.errors import UnknownNameError
from vkc_pin.importing.objects.clean_up import (
    add_missing_limits,
    choose_name,
    compute_bounds,
    extract_subtree,
    find_multiple_objects,
    load_surfaces,
    make_upright,
    merge_fixed_links,
    move_root,
    scale_object,
)
from vkc_pin.importing.objects.description import Description, Joint, Link, Part
from vkc_pin.importing.objects.urdf import read_object_urdf
from vkc_pin.world.files.fields import Name


@pytest.fixture
def cabinet(tmp_path: Path) -> Description:
    return read_object_urdf(write_partnet_object(tmp_path))


def test_fixed_links_are_merged(cabinet: Description) -> None:
    found = merge_fixed_links(cabinet)
    assert set(found.links) == {"base", "link_0", "link_1"}
    assert found.joints["link_0"].parent == "base"
    assert any("joint_3" in note and "no" in note for note in found.notes)
    before, after = (
        compute_bounds(cabinet, load_surfaces(cabinet)),
        compute_bounds(found, load_surfaces(found)),
    )
    assert np.allclose(before, after)
    assert "link_2_frame-1" in [part.name for part in found.links["base"].visual]


@settings(max_examples=5, deadline=None)
@given(factor=st.floats(0.1, 10.0), slide=st.floats(0.0, 0.36))
def test_scaling_scales_shapes_and_limits(
    factor: float, slide: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    cabinet = read_object_urdf(write_partnet_object(tmp_path_factory.mktemp("p") / "x"))
    large = scale_object(cabinet, factor)
    one = compute_bounds(cabinet, load_surfaces(cabinet), {"joint_0": slide})
    other = compute_bounds(large, load_surfaces(large), {"joint_0": factor * slide})
    assert np.allclose(factor * np.array(one), other, rtol=1e-9, atol=1e-9)
    assert large.joints["link_0"].limits == pytest.approx((0.0, factor * 0.36))


def test_inertia_is_merged_scaled_and_rotated() -> None:
    """A handle is fixed to a door, and a flap with equal limits to the handle."""
    place = pin.SE3(np.eye(3), np.array([0.0, 0.5, 0.0]))
    box = Part(name="", placement=pin.SE3.Identity(), kind="box", size=(0.1, 0.1, 0.1))
    inertia = pin.Inertia(2.0, np.array([0.1, 0.2, 0.3]), np.diag([0.1, 0.2, 0.25]))
    parents = {"door": "case", "handle": "door", "flap": "handle"}
    limits = {"door": (0.0, 1.0), "handle": None, "flap": (0.3, 0.3)}
    joints = {
        child: Joint(
            name=f"{child}_joint",
            kind="revolute" if limits[child] else "fixed",
            parent=parent,
            child=child,
            placement=place,
            limits=limits[child],
        )
        for child, parent in parents.items()
    }
    links = {name: Link(name, (), (box,), inertia) for name in ("case", *parents)}
    merged = merge_fixed_links(Description(Path("f"), links, joints))
    assert set(merged.links) == {"case", "door"}
    door = merged.links["door"]
    flap = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.0, 0.0), np.array([0.0, 1.0, 0.0]))
    assert [part.name for part in door.collision] == ["", "handle", "flap"]
    assert np.allclose(door.collision[2].placement.homogeneous, flap.homogeneous)
    assert door.inertia.isApprox(inertia + place.act(inertia) + flap.act(inertia))
    assert any("flap_joint" in note for note in merged.notes)
    single = Description(Path("f"), {"a": Link("a", inertia=inertia)}, {})
    large = scale_object(single, 3.0).links["a"].inertia
    assert large.isApprox(pin.Inertia(2.0, 3.0 * inertia.lever, 9.0 * inertia.inertia))
    rotated = make_upright(single, "y").links["a"].inertia
    assert np.allclose(rotated.lever, [0.1, -0.3, 0.2])
    assert not single.is_massless


def test_long_chains_of_fixed_links_are_merged() -> None:
    """A hinge connects the last of 1500 links, followed by two links without shapes."""
    count, step = 1500, pin.SE3(np.eye(3), np.array([0.01, 0.0, 0.0]))
    box = Part(name="", placement=pin.SE3.Identity(), kind="box", size=(0.1, 0.1, 0.1))
    kinds = dict.fromkeys(range(1, count - 1), "fixed") | dict.fromkeys(
        range(count - 1, count + 2), "revolute"
    )
    joints = {
        f"l{k}": Joint(
            name=f"j{k}",
            kind=kind,
            parent=f"l{k - 1}",
            child=f"l{k}",
            placement=step,
            limits=(0.0, 1.0),
        )
        for k, kind in kinds.items()
    }
    links = {f"l{k}": Link(f"l{k}", (), (box,) * (k < count)) for k in range(count + 2)}
    merged = merge_fixed_links(Description(Path("f"), links, joints))
    assert list(merged.links) == ["l0", f"l{count - 1}"]
    (hinge,) = merged.joints.values()
    assert hinge.parent == "l0"
    assert hinge.placement.translation == pytest.approx([0.01 * (count - 1), 0.0, 0.0])
    assert len(merged.links["l0"].collision) == count - 1
    assert [f"link 'l{k}'" in note for k, note in enumerate(merged.notes, count)] == [True] * 2


def test_separate_objects_in_one_file_are_noted(tmp_path: Path) -> None:
    def format_box(name: str, parent: str, kind: str) -> str:
        return (
            f'<link name="{name}"><collision><geometry><box size="1 1 1"/></geometry></collision>'
            f'</link><joint name="{name}_joint" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{name}"/><axis xyz="0 0 1"/><limit lower="0" upper="1"/></joint>'
        )

    def find_notes(*parts: str) -> tuple[str, ...]:
        file = tmp_path / "it.urdf"
        file.write_text(f'<robot name="it"><link name="world"/>{"".join(parts)}</robot>')
        return find_multiple_objects(read_object_urdf(file))

    oven = format_box("oven", "world", "fixed") + format_box("door", "oven", "revolute")
    chest = format_box("chest", "world", "fixed") + format_box("lid", "chest", "revolute")
    (note,) = find_notes(oven, chest, format_box("rack", "chest", "prismatic"))
    assert "'oven' (1 joint), 'chest' (2 joints)" in note
    assert find_notes(oven) == find_notes(oven, format_box("wall", "world", "fixed")) == ()
    drawers = format_box("upper", "world", "prismatic"), format_box("lower", "world", "prismatic")
    assert find_notes(*drawers) == ()


def test_missing_limits_open_outwards(cabinet: Description) -> None:
    found = merge_fixed_links(cabinet)
    meshes = load_surfaces(found)
    limited = add_missing_limits(found, meshes)
    low, high = limited.joints["link_1"].limits or (0.0, 0.0)
    assert sorted(map(abs, (low, high))) == pytest.approx([0.0, np.pi / 2])
    shut, opened = (
        compute_bounds(limited, load_surfaces(limited), {"joint_1": value})
        for value in (0.0, low if abs(low) > high else high)
    )
    grows = opened[1][0] - opened[0][0] > shut[1][0] - shut[0][0] + 0.1
    assert grows  # the door opens to the front, along x
    assert any("joint_1" in note and "1.57" in note for note in limited.notes)
    assert limited.joints["link_0"].limits == (0.0, 0.36)
    narrow = dataclasses.replace(
        limited.joints["link_1"], limits=(0.0, 0.0274)
    )  # 1.57 read as degrees
    notes = add_missing_limits(
        dataclasses.replace(limited, joints={**limited.joints, "link_1": narrow}),
        load_surfaces(limited),
    ).notes
    assert any("only 1.6°" in note or "only 2°" in note for note in notes)


def test_subtree_is_extracted_rotated_and_moved(cabinet: Description) -> None:
    found = make_upright(extract_subtree(cabinet, "link_2"), "y")
    low, high = compute_bounds(found, load_surfaces(found))
    assert (high - low)[2] == pytest.approx(1.0)
    moved = move_root(found, pin.SE3(np.eye(3), np.array([0.0, 0.0, -low[2]])))
    assert compute_bounds(moved, load_surfaces(moved))[0][2] == pytest.approx(0.0)
    with pytest.raises(UnknownNameError, match="link_2"):
        extract_subtree(cabinet, "link2")


@given(st.lists(st.text(max_size=5), max_size=8))
def test_chosen_names_are_valid_and_distinct(wanted: list[str]) -> None:
    taken = set[str]()
    names = [choose_name(name, taken) for name in wanted]
    assert len(set(names)) == len(names)
    assert taken == set(names)
    for name in names:
        TypeAdapter(Name).validate_python(name)
