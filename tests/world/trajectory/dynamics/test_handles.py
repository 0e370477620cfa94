"""What a hand exerts at handles: in closed form where that is known, and by the work that it does."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.closers import changed, closer
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.trajectory.dynamics.handles import Handle, Motion

REAL = st.floats(-1.0, 1.0)


def motion(**coordinates: tuple[float, float, float]) -> Motion:
    """Return one moment: coordinate (`_` for `.`) → position, velocity, acceleration."""
    parts = (
        {name.replace("_", ".", 1): np.array([row[k]]) for name, row in coordinates.items()}
        for k in range(3)
    )
    return Motion(*parts)


def drawer(**resistance: float) -> vkc.Scene:
    return changed(vkc.load_scene("drawer"), "drawer", joints={"slide": resistance})


@pytest.mark.parametrize("riding", [0.0, 2.5])
def test_a_drawer_is_pulled_along_its_slide_by_all_that_resists(riding: float) -> None:
    scene = drawer(friction=8.0, damping=20.0, stiffness=50.0, springref=-0.1)
    handle = Handle(
        scene,
        vkc.Hold("drawer", "handle"),
        [(1, pin.Inertia(riding, np.zeros(3), np.zeros((3, 3))))],
    )
    (wrench,) = handle.wrenches(motion(drawer_slide=(0.2, 0.3, 0.5)))
    expected = 8.0 + 20.0 * 0.3 + 50.0 * 0.3 + (5.0 + riding) * 0.5
    placed = scene.objects["drawer"]
    opened = (placed.object.link_placement("tray", [value]).translation for value in (1.0, 0.0))
    way = placed.placement.rotation @ np.subtract(*opened)
    np.testing.assert_allclose(wrench, [*(expected * way), 0.0, 0.0, 0.0], atol=1e-9)


def test_friction_pulls_back_whichever_way_and_not_at_rest() -> None:
    handle = Handle(drawer(friction=8.0), vkc.Hold("drawer", "handle"))
    ahead, back, rest = (
        handle.forces(motion(drawer_slide=(0.2, v, 0.0)))[0, 0] for v in (0.1, -0.1, 0.0)
    )
    assert (ahead, back, rest) == pytest.approx((8.0, -8.0, 0.0))


@pytest.mark.parametrize("attachment", ["handle", "handle_free", "push"])
@settings(max_examples=30, deadline=None)
@given(REAL, REAL, REAL, st.floats(0.05, 0.7), REAL, REAL)
def test_a_hand_does_the_work_that_the_joints_ask_for_and_none_along_its_freedoms(
    attachment: str, q: float, v: float, a: float, knob: float, turn: float, other: float
) -> None:
    scene = closer(stiffness=5.0, springref=-2.0, damping=3.0)
    attached = scene.objects["door"].object.attachment(attachment)
    values = dict.fromkeys(attached.coordinates, (0.1 * turn, 0.0, 0.0))
    now = motion(
        door_hinge=(q, v, a),
        door_knob=(knob, other, 0.0),
        **{f"door_{name}": row for name, row in values.items()},
    )
    handle, placed = Handle(scene, vkc.Hold("door", attachment)), scene.objects["door"]
    (wrench,), (asked,) = handle.wrenches(now), handle.forces(now)

    def tool(hinge: float, lever: float, freedom: float) -> pin.SE3:
        where = placed.placement * placed.object.link_placement(attached.link, [hinge, lever])
        return where * attached.tool(
            [freedom, *(0.1 * turn for _ in attached.coordinates[1:])][: len(attached.coordinates)]
        )

    def work(*nudged: tuple[float, float, float]) -> float:
        more, less = (tool(*row) for row in nudged)
        turned = pin.log3(more.rotation @ less.rotation.T)
        return (
            float(wrench[:3] @ (more.translation - less.translation) + wrench[3:] @ turned) / 2e-5
        )

    def around(column: int) -> float:
        return work(
            *(
                (np.array([q, knob, 0.1 * turn]) + sign * 1e-5 * np.eye(3)[column])
                for sign in (1.0, -1.0)
            )
        )

    assert around(0) == pytest.approx(asked[0], rel=1e-5, abs=1e-6)
    if attachment != "push":
        assert around(1) == pytest.approx(asked[1], rel=1e-5, abs=1e-6)
    if attachment == "handle_free":
        assert around(2) == pytest.approx(0.0, abs=1e-6)
    if attachment == "push":
        approach = tool(q, knob, 0.0).rotation[:, 2] if not turn else None
        np.testing.assert_array_equal(wrench[3:], 0.0)
        if approach is not None:
            assert abs(wrench[:3] @ approach) == pytest.approx(float(np.linalg.norm(wrench[:3])))


def test_no_other_wrench_that_does_it_is_less() -> None:
    handle = Handle(closer(stiffness=5.0, springref=-2.0), vkc.Hold("door", "handle"))
    (wrench,) = handle.wrenches(motion(door_hinge=(0.6, 0.2, 0.1), door_knob=(0.5, 0.0, 0.0)))
    weigh = np.array([1.0] * 3 + [0.1] * 3)
    force = float(np.linalg.norm(wrench[:3]))
    assert force == pytest.approx(
        13.0 / 0.74, rel=0.1
    )  # Q over the lever, and the inertia of the panel
    assert float(np.linalg.norm(wrench / weigh)) == pytest.approx(force, rel=0.1)


def test_a_bolt_and_a_stop_carry_what_rests_against_them() -> None:
    shut = motion(door_hinge=(0.0, 0.0, 0.0), door_knob=(0.2, 0.5, 0.0))
    handle = Handle(closer(stiffness=5.0, springref=-2.0), vkc.Hold("door", "handle"))
    assert handle.forces(shut)[0, 0] == 0.0
    leaving = motion(door_hinge=(0.0, 0.0, 0.5), door_knob=(0.5, 0.0, 0.0))
    assert handle.forces(leaving)[0, 0] > 10.0
    slide = Handle(drawer(stiffness=50.0, springref=-1.0), vkc.Hold("drawer", "handle"))
    assert slide.forces(motion(drawer_slide=(0.0, 0.0, 0.0)))[0, 0] == 0.0
    assert slide.forces(motion(drawer_slide=(0.1, 0.0, 0.0)))[0, 0] == pytest.approx(55.0)
