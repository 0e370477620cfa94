"""Tests the conversion of coal shapes and placements, library versions, and numbers of threads."""

from __future__ import annotations

import os
import subprocess
import sys
import types

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error

from vkc_pin import BuildError
from vkc_pin.world.collision import solids
from vkc_pin.world.collision.distances import Shapes
from vkc_pin.world.collision.solids import convert_solid, count_threads, flatten_placements
from vkc_pin.world.files.meshes import make_convex_hull


@pytest.mark.parametrize(
    ("requested", "expected"), [("1", 1), ("3", 3), ("0", 1), ("nonsense", 8), ("", 8)]
)
def test_thread_count_respects_cores_and_environment(
    requested: str, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", requested)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(12)), raising=False)
    assert count_threads() == expected
    assert Shapes([coal.Sphere(0.1)]).threads == expected
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert count_threads() == 1


def make_hull(seed: int) -> coal.Convex:
    return make_convex_hull(np.random.default_rng(seed).normal(size=(30, 3)))


def test_other_types_raise() -> None:
    with expect_error("object"):
        convert_solid(object())


def test_hulls_are_cached_until_they_change() -> None:
    shape = make_hull(0)
    first = convert_solid(shape)
    assert convert_solid(shape) is first
    shape.setSweptSphereRadius(0.1)
    assert convert_solid(shape) is not first
    assert convert_solid(make_hull(1)) is not convert_solid(shape)


def test_changed_dimensions_take_effect() -> None:
    """Primitives are converted at every call."""
    box, ball = coal.Box(1.0, 1.0, 1.0), coal.Sphere(0.1)
    placements = flatten_placements([pin.SE3.Identity(), pin.SE3(np.eye(3), 2.0 * np.eye(3)[0])])

    def compute_distance() -> float:
        pair = np.zeros(1, int), np.array([[0, 1]])
        return float(Shapes([box, ball]).compute_distances(placements[None], *pair)[0])

    assert compute_distance() == pytest.approx(1.4, abs=1e-6)
    box.halfSide = np.array([1.0, 0.5, 0.5])
    assert compute_distance() == pytest.approx(0.9, abs=1e-6)
    ball.setSweptSphereRadius(0.2)
    assert compute_distance() == pytest.approx(0.7, abs=1e-6)


def test_incompatible_modules_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    """The module was compiled against other releases."""
    solids.load_compiled.cache_clear()
    for coal_version, pinocchio_version, message in (
        ("2.9.1", pin.__version__, r"against coal 2\.9\.1"),
        (coal.__version__, "3.9.0", r"pin 3\.9\.0"),
    ):
        with monkeypatch.context() as patch:
            built = types.SimpleNamespace(
                COAL_VERSION=coal_version, PINOCCHIO_VERSION=pinocchio_version
            )
            patch.setattr(solids, "import_compiled", lambda _, built=built: built)
            with pytest.raises(BuildError, match=message):
                solids.load_compiled()

    solids.load_compiled.cache_clear()
    assert coal.__version__ == solids.load_compiled().COAL_VERSION


_FIRST_QUERY = """
import numpy as np
from vkc_pin.world.collision.distances import Shapes
import coal
turn = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
where = np.array([[[*turn, 0, 0, 0], [*turn, -2, 0, 0]]])
shapes = Shapes([coal.Box(1.0, 1.0, 1.0), coal.Box(1.0, 1.0, 1.0)])
print(float(shapes.compute_distances(where, np.zeros(1, int), np.array([[0, 1]]))[0]).hex())
"""


def test_box_sizes_do_not_depend_on_the_first_query() -> None:
    """A first query along an axis would make coal enlarge boxes by 1e-10 from then on."""
    outputs = {
        subprocess.run(
            [sys.executable, "-c", before + _FIRST_QUERY],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        ).stdout
        for before in ("", "import vkc_pin as vkc; vkc.load_scene('door')\n")
    }
    assert len(outputs) == 1
    assert float.fromhex(outputs.pop().strip()) == pytest.approx(1.0, abs=1e-12)
