from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.importing.objects.description import Description, Joint, Link, Part


def test_part_meshes_have_volume_and_placement() -> None:
    placement = pin.SE3(np.eye(3), np.array([1.0, 2.0, 3.0]))
    for kind, size, volume in (
        ("box", (0.1, 0.2, 0.3), 0.006),
        ("sphere", (0.1,), 4.0 / 3.0 * np.pi * 1e-3),
        ("cylinder", (0.1, 0.2), np.pi * 2e-3),
        ("capsule", (0.1, 0.2), np.pi * 2e-3 + 4.0 / 3.0 * np.pi * 1e-3),
    ):
        mesh = Part(name="", placement=placement, kind=kind, size=size).make_mesh()
        assert mesh.volume == pytest.approx(volume, rel=0.02)
        assert np.allclose(mesh.bounds.mean(axis=0), [1.0, 2.0, 3.0], atol=1e-6)


def test_placements_follow_the_joints() -> None:
    placement, axis = pin.SE3(np.eye(3), np.array([1.0, 0.0, 0.0])), np.array([0.0, 0.0, 1.0])
    joints = {
        "c": Joint(
            name="slide", kind="prismatic", parent="b", child="c", placement=placement, axis=axis
        ),
        "b": Joint(
            name="turn", kind="revolute", parent="a", child="b", placement=placement, axis=axis
        ),
    }
    found = Description(Path("f"), {name: Link(name) for name in "abc"}, joints)
    assert found.root == "a"
    assert np.allclose(
        found.compute_placements({"turn": np.pi / 2, "slide": 0.3})["c"].translation,
        [1.0, 1.0, 0.3],
    )
    assert found.subtree("b") == {"b", "c"}
