"""Tests the search for coupled joints, their validation, their models and their limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.arm_urdf import write_arms
from helpers.expected_errors import expect_error
from helpers.robots import compute_placement
from helpers.telescopes import format_joint, format_link, write_telescope
from helpers.texts import replace_in_file
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning import kinematics as cpin
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.couplings import JointCoupling, find_followers, tighten_coupled_limits
from vkc_pin.world.models.robot_model import (
    build_full_model,
    build_planned_model,
    compute_rest_positions,
    make_configuration,
)


def write_chain(tmp_path: Path, *contents: str) -> Path:
    """Write a chain of joints j1, j2, ... with given contents, and shapes on every other link."""
    parts = [format_link("l0", "0.1 0.1 0.1")]
    for k, text in enumerate(contents, start=1):
        parts += [
            format_link(f"l{k}", "0.1 0.1 0.1" if k % 2 else ""),
            format_joint(f"j{k}", "prismatic", f"l{k - 1}", f"l{k}", inside=text),
        ]
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="robot">{"".join(parts)}</robot>')
    return path


def format_mimic(leader: str, multiplier: float = 1.0, offset: float = 0.0) -> str:
    return f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'


@pytest.mark.parametrize(
    ("contents", "expected"),
    [
        (  # j3 = -0.5·j2 + 0.2 and j2 = 2·j1 + 0.1
            ("", format_mimic("j1", 2.0, 0.1), format_mimic("j2", -0.5, 0.2)),
            {"j2": ("j1", 2.0, 0.1), "j3": ("j1", -1.0, 0.15)},
        ),
        (  # j1 = 2·j3 + 0.1 and j2 = -4·j3
            (format_mimic("j3", 2.0, 0.1), format_mimic("j3", -4.0), ""),
            {"j3": ("j1", 0.5, -0.05), "j2": ("j1", -2.0, 0.2)},
        ),
    ],
    ids=["chain", "leader below its follower"],
)
def test_couplings_are_resolved_to_the_leader_nearest_to_the_base(
    tmp_path: Path, contents: tuple[str, ...], expected: dict[str, tuple[str, float, float]]
) -> None:
    found = find_followers(read_urdf(write_chain(tmp_path, *contents)).root)
    assert found.keys() == expected.keys()
    for joint, (leader, *numbers) in expected.items():
        assert found[joint].leader == leader
        assert [found[joint].factor, found[joint].offset] == pytest.approx(numbers)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (("", format_mimic("j3"), format_mimic("j2")), "j2: couplings are circular.* j2 → j3 → j2"),
        (("", format_mimic("j2")), "j2: couplings are circular.* j2 → j2"),
        (
            ("", format_mimic("other")),
            "j2: .*follows one that cannot move.*'other', which does not exist",
        ),
        (
            ("", format_mimic("j3"), format_mimic("still")),
            "j2: .*follows one that cannot move.*'still', which is fixed",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:.*there is no joint")
def test_leaders_that_cannot_move_raise(
    tmp_path: Path, contents: tuple[str, ...], message: str
) -> None:
    path = write_chain(tmp_path, *contents)
    fixed = format_link("aside") + format_joint("still", "fixed", "l0", "aside")
    path.write_text(path.read_text().replace("</robot>", fixed + "</robot>"))
    with expect_error(message, file=path, line=1):
        vkc.load_robot(path, pairs="all", tool_frame=f"l{len(contents)}")


def test_invalid_couplings_off_the_tool_path_are_ignored(tmp_path: Path) -> None:
    """The fingers of published robots have such couplings."""
    path = write_chain(tmp_path, "", "", format_mimic("other"))
    with pytest.warns(UserWarning, match="there is no joint 'other'"):
        robot = vkc.load_robot(path, pairs="all", tool_frame="l2")
    assert robot.coordinates.names[3:] == ("j1", "j2")


def test_couplings_of_robot_yaml_override_the_urdf(tmp_path: Path) -> None:
    """Both the short and the full form are read."""
    write_chain(tmp_path, "", format_mimic("j1", 3.0), "")
    text = (
        "urdf: robot.urdf\ntool_frame: l3\ncouplings:\n  j2: j1\n"
        "  j3: {joint: j2, multiplier: -2.0, offset: 0.5}\n"
    )
    (tmp_path / "robot.yaml").write_text(text)
    found = find_followers(vkc.load_robot(tmp_path, pairs="all").file.root)
    assert found == {"j2": JointCoupling("j1", 1.0, 0.0), "j3": JointCoupling("j1", -2.0, 0.5)}


@pytest.mark.parametrize(
    ("couplings", "field", "message"),
    [
        ("out_2: out1", "out_2", "'out1'; did you mean 'out_1'"),
        ("oat_2: out_1", "oat_2", "no joint that turns or slides 'oat_2'; did you mean 'out_2'"),
        ("out_2: out_3, out_3: out_2", "out_2", "circular"),
        ("out_2: {joint: out_1, multiplier: 0}", "out_2.multiplier", "must not be 0"),
        ("out_2: {joint: out_1, multiplier: yes}", "out_2.multiplier", "a number"),
        ("out_2: {joint: out_1, factor: 2}", "out_2.factor", "multiplier"),
        ("out_2: {multiplier: 2}", "out_2.joint", "missing"),
        ("out_2: 3", "out_2", "."),
    ],
)
def test_invalid_couplings_raise(tmp_path: Path, couplings: str, field: str, message: str) -> None:
    path = write_telescope(tmp_path, couplings=couplings)
    with expect_error(message, file=path, line=5, field=f"couplings.{field}"):
        vkc.load_robot(path)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            "locked_joints: {out_3: 0.0}",
            "locked_joints.out_3: .* follows one that is not locked.*'out_1' is not locked",
        ),
        (
            "home: {out_1: 0.1, out_3: 0.0}",
            "home.out_3: this joint follows 'out_1'.*0.1, or no value.*got 0",
        ),
        (
            "locked_joints: {out_1: 0.1, out_2: 0.05}",
            r"robot.yaml.*locked_joints.out_2: this joint follows 'out_1'.*0.1, or no.*got 0.05",
        ),
        ("locked_joints: {out_1: 0.1, out_3: 0.1, out_4: 0.0}", "locked_joints.out_4: .*got 0"),
        (
            "home: {out_2: 0.05}\nlocked_joints: {out_1: 0.1}",
            "home.out_2: this joint follows 'out_1'.*0.1, or no value.*got 0.05",
        ),
        ("home: {out_1: 0.2}", "home.out_1: .*outside the joint.s limits"),
    ],
)
def test_rest_positions_must_respect_couplings(tmp_path: Path, more: str, message: str) -> None:
    with expect_error(message):
        vkc.load_robot(write_telescope(tmp_path, more=more))


@pytest.mark.parametrize("positions", [{"a": 0.03, "b": 0.01}, {"b": 0.01}, {"a": -0.02, "b": 0.0}])
def test_locked_fingers_must_respect_couplings(tmp_path: Path, positions: dict[str, float]) -> None:
    """Of two fingers beside the path to the tool, the second one moves 1 cm behind the first."""
    file = write_arms(tmp_path)
    joint = '<axis xyz="0 -1 0"/>'
    mimic = '<mimic joint="finger_a_joint" offset="-0.01"/>'
    replace_in_file(file, (joint, joint + mimic), ('lower="0.0"', 'lower="-0.05"'))
    locked = {f"finger_{name}_joint": value for name, value in positions.items()}
    with expect_error("this joint follows 'finger_a_joint'", field="locked_joints.finger_b_joint"):
        vkc.load_robot(file, tool_frame="hand", locked_joints=locked, pairs="all")
    leader = positions.get("a", 0.0)
    locked["finger_b_joint"] = leader - 0.01
    robot = vkc.load_robot(file, tool_frame="hand", locked_joints=locked, pairs="all")
    place = robot.model.frames[robot.model.getFrameId("finger_b")].placement
    between = robot.model.frames[robot.model.getFrameId("finger_a")].placement.actInv(place)
    assert between.translation[1] == pytest.approx(-(2.0 * leader - 0.01), abs=1e-9)


def test_locking_a_leader_locks_its_followers(tmp_path: Path) -> None:
    robot = vkc.load_robot(write_telescope(tmp_path, more="locked_joints: {out_1: 0.1}\n"))
    assert robot.coordinates.names[3:] == ("lift", "yaw_joint", "pitch_joint", "roll_joint")
    free = vkc.load_robot(
        write_telescope(tmp_path / "free", more="home: {out_1: 0.1, out_2: 0.1}\n")
    )
    tool = [one.model.frames[one.model.getFrameId("tool")] for one in (robot, free)]
    assert tool[0].placement.isApprox(tool[1].placement, 1e-12)


KINDS = ("revolute", "prismatic", "continuous")


def make_random_robot(rng: np.random.Generator) -> tuple[str, str]:
    """Return a URDF of a random tree with random couplings, and its tool link."""
    count = int(rng.integers(3, 8))
    parts, order = [format_link("l0", "0.1 0.1 0.1")], rng.permutation(count)
    leaders = {
        int(one): int(other)
        for k, one in enumerate(order)
        for other in order[:k]
        if rng.random() < 0.3
    }
    for k in range(count):
        multiplier = rng.uniform(0.3, 2.0) * rng.choice([-1, 1])
        mimic = format_mimic(f"j{leaders.get(k)}", multiplier, rng.uniform(-0.3, 0.3))
        inside = mimic if k in leaders else ""
        above = f"l{k if rng.random() < 0.7 else rng.integers(0, k + 1)}"
        at, axis = (" ".join(map(str, rng.normal(size=3))) for _ in range(2))
        kind = str(rng.choice(KINDS))
        parts += [
            format_link(f"l{k + 1}", "0.1 0.1 0.1", at),
            format_joint(f"j{k}", kind, above, f"l{k + 1}", at, axis, (-5.0, 5.0), inside=inside),
        ]
    return f'<robot name="robot">{"".join(parts)}</robot>', f"l{count}"


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_kinematics_match_independent_joints(seed: int) -> None:
    """Compares placements with those of independent joints, and Jacobians with Pinocchio's."""
    rng = np.random.default_rng(seed)
    text, tool = make_random_robot(rng)
    file = read_urdf(Path("robot.urdf"), text=text)
    single = build_full_model(file)
    full = tighten_coupled_limits(single, file, tool)
    rest = compute_rest_positions(full, file, {})
    model, followers = build_planned_model(full, file, tool, rest, {}), find_followers(file.root)
    coordinates = Coordinates(model)
    z = rng.uniform(-1.0, 1.0, coordinates.size)

    def make_full_configuration(z: np.ndarray) -> np.ndarray:
        at = {**rest, **dict(zip(coordinates.names[3:], z[3:], strict=True))}
        at |= {
            name: coupling.factor * at[coupling.leader] + coupling.offset
            for name, coupling in followers.items()
        }
        q = make_configuration(single, at)
        q[:4] = z[0], z[1], np.cos(z[2]), np.sin(z[2])
        return q

    data, single_data = model.createData(), single.createData()
    pin.framesForwardKinematics(model, data, coordinates.q(z))
    pin.framesForwardKinematics(single, single_data, make_full_configuration(z))
    for frame in single.frames:
        if frame.type == pin.FrameType.BODY:
            ours = data.oMf[model.getFrameId(frame.name, frame.type)]
            expected = single_data.oMf[single.getFrameId(frame.name, frame.type)]
            np.testing.assert_allclose(ours, expected, atol=1e-9)

    frame, kind = model.getFrameId(tool, pin.FrameType.BODY), pin.LOCAL_WORLD_ALIGNED
    expected = pin.computeFrameJacobian(model, data, coordinates.q(z), frame, kind)
    jacobian = np.array(cpin.frame_jacobian(model, tool)(coordinates.q(z)))
    np.testing.assert_allclose(jacobian, expected, atol=1e-9)


def test_dynamics_include_followers(tmp_path: Path) -> None:
    robot = vkc.load_robot(write_telescope(tmp_path))
    model, rng = pin.Model(robot.model), np.random.default_rng(0)
    for j in range(1, model.njoints):
        model.inertias[j] = pin.Inertia.Random()
    z, v, a = rng.uniform(-0.5, 0.5, (3, model.nv))
    q, data = robot.coordinates.q(z), model.createData()
    torques, expected = cpin.rnea(model)(q, v, a), pin.rnea(model, data, q, v, a)
    np.testing.assert_allclose(np.array(torques).ravel(), expected, atol=1e-9)
    center, expected = cpin.center_of_mass(model)(q), pin.centerOfMass(model, data, q)
    np.testing.assert_allclose(np.array(center).ravel(), expected, atol=1e-9)


def test_leaders_may_be_on_another_branch(tmp_path: Path) -> None:
    """As in a palletizer, the follower is on the path to the tool, its leader is not."""
    mimic = format_mimic("leader", -1.0)
    parts = [
        *(format_link(name, "0.1 0.1 0.1", f"0 0 {k}") for k, name in enumerate("rab")),
        format_joint("follower", "revolute", "r", "a", limits=(-1.0, 0.5), inside=mimic),
        format_joint("leader", "revolute", "r", "b"),
    ]
    file = tmp_path / "robot.urdf"
    file.write_text(f'<robot name="robot">{"".join(parts)}</robot>')
    robot = vkc.load_robot(file, tool_frame="a", pairs="all")
    assert robot.coordinates.names[3:] == ("leader",)
    assert (robot.lower[3], robot.upper[3]) == (-0.5, 1.0)
    turned = compute_placement(robot, "a", np.array([0.0, 0.0, 0.0, 0.4])).rotation
    np.testing.assert_allclose(turned, pin.utils.rotate("z", -0.4), atol=1e-12)


def make_coupled_robot(
    tmp_path: Path,
    inside: str,
    *,
    limits: tuple[float, float] = (-1.0, 1.0),
    leader_limits: tuple[float, float] = (-1.0, 1.0),
    kinds: tuple[str, str] = ("revolute", "revolute"),
    yaml: str = "",
) -> vkc.Robot:
    """Return a robot with two joints, of which the second follows the first."""
    parts = [
        *(format_link(f"l{k}", "0.1 0.1 0.1", f"0 0 {k}") for k in range(3)),
        format_joint("one", kinds[0], "l0", "l1", limits=leader_limits, velocity=0.4),
        format_joint("two", kinds[1], "l1", "l2", limits=limits, velocity=0.6, inside=inside),
    ]
    (tmp_path / "robot.urdf").write_text(f'<robot name="robot">{"".join(parts)}</robot>')
    (tmp_path / "robot.yaml").write_text(f"urdf: robot.urdf\ntool_frame: l2\n{yaml}")
    return vkc.load_robot(tmp_path, pairs="all")


@pytest.mark.parametrize(
    ("multiplier", "offset", "follower", "expected", "velocity"),
    [
        (1.0, 0.0, (-1.0, 1.0), (-1.0, 1.0), 0.4),
        (1.0, 0.0, (0.2, 0.6), (0.2, 0.6), 0.4),
        (2.0, 0.0, (-1.0, 1.0), (-0.5, 0.5), 0.3),
        (-2.0, 0.4, (-1.0, 1.0), (-0.3, 0.7), 0.3),
        (0.5, 0.0, (-0.1, 3.0), (-0.2, 1.0), 0.4),
        (-0.5, 0.0, (0.1, 0.2), (-0.4, -0.2), 0.4),
        (0.0, 0.3, (-1.0, 1.0), (-1.0, 1.0), 0.4),
    ],
)
def test_the_tightest_limits_apply(
    tmp_path: Path,
    multiplier: float,
    offset: float,
    follower: tuple[float, float],
    expected: tuple[float, float],
    velocity: float,
) -> None:
    """The home position respects them too: it is 0, or in the middle."""
    mimic = format_mimic("one", multiplier, offset)
    robot = make_coupled_robot(tmp_path, mimic, limits=follower)
    assert robot.coordinates.names[3:] == ("one",)
    home = 0.0 if expected[0] <= 0.0 <= expected[1] else sum(expected) / 2
    np.testing.assert_allclose(
        [robot.lower[3], robot.upper[3], robot.velocity[3], robot.home[0]],
        [*expected, velocity, home],
        rtol=1e-12,
    )


def test_robot_yaml_limits_any_coupled_joint(tmp_path: Path) -> None:
    robot = make_coupled_robot(
        tmp_path,
        format_mimic("one", 2.0),
        yaml="joints: {one: {acceleration: 3.0}, two: {velocity: 0.1, acceleration: 4.0}}\n",
    )
    assert (robot.velocity[3], robot.acceleration[3]) == (0.05, 2.0)


def test_default_limits_apply_to_the_fastest_joint(tmp_path: Path) -> None:
    couplings = (
        "out_2: {joint: out_1, multiplier: 0.5}, "
        "out_3: {joint: out_1, multiplier: -2.0, offset: 0.15}"
    )
    file = write_telescope(tmp_path, couplings=couplings).parent / "robot.urdf"
    file.write_text(file.read_text().replace('velocity="0.5" ', ""))
    robot = vkc.load_robot(tmp_path)
    assert (robot.velocity[4], robot.acceleration[4]) == (0.05, 0.7)


@pytest.mark.parametrize(("second", "limit"), [("revolute", 0.5), ("continuous", np.inf)])
def test_continuous_leaders_become_revolute(tmp_path: Path, second: str, limit: float) -> None:
    """A full turn of the leader changes the position of a follower with another factor."""
    robot = make_coupled_robot(tmp_path, format_mimic("one", 2.0), kinds=("continuous", second))
    assert (robot.lower[3], robot.upper[3]) == (-limit, limit)
    z = np.array([0.0, 0.0, 0.0, np.pi])
    np.testing.assert_allclose(robot.coordinates.z(robot.coordinates.q(z)), z)
    assert robot.model.joints[2].nq == 1


def test_incompatible_limits_raise(tmp_path: Path) -> None:
    message = "one: no position satisfies the limits of its follower 'two'.*2 to 3.*-1 to 1"
    with expect_error(message):
        make_coupled_robot(tmp_path, format_mimic("one"), limits=(2.0, 3.0))


@pytest.mark.parametrize(
    ("multiplier", "offset", "limits", "value"),
    [
        (-1.0, 0.0, (0.0, 0.055), 0.0),
        (-2.0, 0.0, (0.0, 1.0), 0.0),
        (-1.0, 0.0, (-0.7, 0.0), 0.0),
        (-0.5, 0.9, (0.2, 0.6), 0.6),
        (1.0, 0.4, (0.1, 0.5), 0.1),
    ],
)
def test_limits_copied_to_a_follower_may_leave_one_position(
    tmp_path: Path, multiplier: float, offset: float, limits: tuple[float, float], value: float
) -> None:
    """The position is not negative zero, which random numbers cannot be drawn up to."""
    mimic = format_mimic("one", multiplier, offset)
    with pytest.warns(UserWarning, match=f"one: the limits of .* 'two' leave it at {value:g}"):
        robot = make_coupled_robot(tmp_path, mimic, limits=limits, leader_limits=limits)
    assert (robot.lower[3], robot.upper[3]) == pytest.approx((value, value))
    assert robot.lower[3] == robot.upper[3]
    assert not np.signbit([robot.lower[3], robot.upper[3]]).any()


def test_a_finger_with_the_limits_of_its_leader_is_imported(tmp_path: Path) -> None:
    """The name of the fingers may make them the end of an arm."""
    box, parts = "0.05 0.05 0.1", [format_link("l0", "0.2 0.2 0.1", "0 0 0.05")]
    for k in range(1, 7):
        axis = ("0 0 1", "0 1 0", "1 0 0")[k % 3]
        parts += [
            format_link(f"l{k}", box),
            format_joint(f"j{k}", "revolute", f"l{k - 1}", f"l{k}", "0 0 0.15", axis),
        ]
    for name, side in (("arm_finger_a", 0.01), ("arm_finger_b", -0.01)):
        mimic = format_mimic("arm_finger_a_joint", -1.0) if side < 0.0 else ""
        parts += [
            format_link(name, "0.02 0.01 0.08", f"0 {side} 0.09"),
            format_joint(
                f"{name}_joint",
                "prismatic",
                "l6",
                name,
                "0 0 0",
                "0 1 0",
                (0.0, 0.05),
                inside=mimic,
            ),
        ]
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{"".join(parts)}</robot>')
    made = vkc.importing.import_robot(tmp_path / "r.urdf", tmp_path / "out")
    assert set(made.robot.coordinates.names) >= {f"j{k}" for k in range(1, 7)}
