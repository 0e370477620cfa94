from __future__ import annotations

import numpy as np
import pytest
from helpers.descriptions import make_description, make_joint, make_part

from vkc_pin.importing.objects.description import Link


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
