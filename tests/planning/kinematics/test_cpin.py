"""Compares the CasADi functions of Pinocchio's algorithms with numeric Pinocchio."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from typing import Any

import casadi
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.errors import BuildError, InputError, UnknownNameError
from vkc_pin.planning import kinematics as cpin
from vkc_pin.planning.kinematics import backends

TOLERANCE = 1e-12
AXIS = np.array([0.36, -0.48, 0.8])


def make_composite() -> pin.JointModelComposite:
    """Return a composite of three joints, one of them continuous."""
    joint = pin.JointModelComposite(pin.JointModelRX())
    joint.addJoint(pin.JointModelPY(), pin.SE3.Random())
    joint.addJoint(pin.JointModelRUBZ(), pin.SE3.Random())
    return joint


def make_unbounded_unaligned() -> pin.JointModel:
    """Return a continuous joint about a slanted axis, as loaded from a URDF."""
    axis = f'<parent link="a"/><child link="b"/><axis xyz="{" ".join(map(str, AXIS))}"/>'
    joint = f'<joint name="j" type="continuous">{axis}</joint>'
    urdf = f'<robot name="r"><link name="a"/><link name="b"/>{joint}</robot>'
    return pin.buildModelFromXML(urdf).joints[1]


JOINTS: dict[str, Callable[[], object]] = {
    "planar": pin.JointModelPlanar,
    "revolute_x": pin.JointModelRX,
    "revolute_z": pin.JointModelRZ,
    "revolute_unaligned": lambda: pin.JointModelRevoluteUnaligned(AXIS),
    "unbounded_x": pin.JointModelRUBX,
    "unbounded_unaligned": make_unbounded_unaligned,
    "prismatic_y": pin.JointModelPY,
    "prismatic_unaligned": lambda: pin.JointModelPrismaticUnaligned(AXIS),
    "composite": make_composite,
    "spherical": pin.JointModelSpherical,
    "spherical_zyx": pin.JointModelSphericalZYX,
    "translation": pin.JointModelTranslation,
    "free_flyer": pin.JointModelFreeFlyer,
    "universal": lambda: pin.JointModelUniversal(np.array([1.0, 0, 0]), np.array([0, 1.0, 0])),
    "helical": lambda: pin.JointModelHelicalUnaligned(AXIS, 0.1),
}
MINIMAL = [
    name for name in JOINTS if name.startswith(("planar", "revolute", "unbounded", "prismatic"))
]


def make_tree(*kinds: str) -> pin.Model:
    """Return a model with a chain of one joint of each kind, each with a body and a fixed frame."""
    pin.seed(7)
    model, parent = pin.Model(), 0
    for kind in kinds:
        parent = model.addJoint(parent, JOINTS[kind](), pin.SE3.Random(), kind)
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Random())
        # Pinocchio's parsers turn a fixed joint into such a frame, with the inertia of its link.
        tip = (f"{kind}_tip", parent, 0, pin.SE3.Random(), pin.FrameType.FIXED_JOINT)
        model.addFrame(pin.Frame(*tip, pin.Inertia.Random()))
    return model


def sample_configurations(model: pin.Model, count: int = 5) -> Iterator[np.ndarray]:
    pin.seed(3)
    bound = 2.0 * np.ones(model.nq)
    for _ in range(count):
        yield pin.randomConfiguration(model, -bound, bound)


def stack_placements(placements: list[pin.SE3]) -> np.ndarray:
    columns = [[*m.rotation.T.ravel(), *m.translation] for m in placements]
    return np.array(columns).reshape(-1, 12).T


def compute_placements(model: pin.Model, q: np.ndarray) -> np.ndarray:
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    return stack_placements([data.oMi[i] for i in range(1, model.njoints)])


@pytest.fixture(scope="module")
def arm() -> pin.Model:
    """Return a chain of all joint types with minimal coordinates."""
    return make_tree(*MINIMAL)


@pytest.mark.parametrize("kind", JOINTS)
def test_kinematics_and_dynamics_equal_numeric_pinocchio(kind: str) -> None:
    model = make_tree(*dict.fromkeys(("planar", kind, "revolute_unaligned")))
    data = model.createData()
    frames = [frame.name for frame in model.frames]
    joints, tips = cpin.joint_placements(model), cpin.frame_placements(model, frames)
    by_index = cpin.frame_placements(model, list(range(model.nframes)))
    torque, com = cpin.rnea(model), cpin.center_of_mass(model)
    random = np.random.default_rng(1)
    for q in sample_configurations(model):
        v, a = random.normal(size=(2, model.nv))
        pin.framesForwardKinematics(model, data, q)
        frame_placements = stack_placements(list(data.oMf))
        for found, expected in (
            (joints(q=q)["M"], compute_placements(model, q)),
            (tips(q=q)["M"], frame_placements),
            (by_index(q=q)["M"], frame_placements),
            (torque(q=q, v=v, a=a)["tau"], pin.rnea(model, data, q, v, a)[:, None]),
            (com(q=q)["com"], pin.centerOfMass(model, data, q)[:, None]),
        ):
            np.testing.assert_allclose(found.full(), expected, atol=TOLERANCE, rtol=TOLERANCE)
    assert model == make_tree(*dict.fromkeys(("planar", kind, "revolute_unaligned")))


@pytest.mark.parametrize("kind", JOINTS)
def test_frame_jacobian_equals_numeric_pinocchio(kind: str) -> None:
    model = make_tree(*dict.fromkeys(("planar", kind)))
    frame, data = model.getFrameId(f"{kind}_tip"), model.createData()
    for reference in ("local_world_aligned", "local", "world"):
        jacobian = cpin.frame_jacobian(model, f"{kind}_tip", reference)
        axes = getattr(pin, reference.upper())
        for q in sample_configurations(model, 2):
            expected = pin.computeFrameJacobian(model, data, q, frame, axes)
            np.testing.assert_allclose(jacobian(q=q)["J"].full(), expected, atol=TOLERANCE, rtol=0)


def test_dynamics_derivatives_equal_numeric_pinocchio() -> None:
    model = make_tree(
        "revolute_x", "prismatic_unaligned", "revolute_unaligned", "prismatic_y", "revolute_z"
    )
    data, random = model.createData(), np.random.default_rng(5)
    q, v, a = random.normal(size=(3, model.nv))
    symbols = [casadi.SX.sym(name, model.nv) for name in "qva"]
    torque = cpin.rnea(model)(*symbols)
    jacobians = [casadi.jacobian(torque, symbol) for symbol in symbols]
    found = casadi.Function("d", symbols, jacobians)(q, v, a)
    expected = pin.computeRNEADerivatives(model, data, q, v, a)
    for derivative, numeric in zip(found, expected, strict=True):
        np.testing.assert_allclose(derivative.full(), numeric, atol=1e-11)
    com = cpin.center_of_mass(model)
    slope = casadi.Function("c", symbols[:1], [casadi.jacobian(com(symbols[0]), symbols[0])])(q)
    np.testing.assert_allclose(slope.full(), pin.jacobianCenterOfMass(model, data, q), atol=1e-11)


def test_rounded_quarter_turns_add_no_instructions() -> None:
    """Rounded quarter turns give the same expressions as exact ones, with constant entries."""
    exact = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    counts = []
    for rotation in (exact, pin.rpy.rpyToMatrix(0, 0, np.pi / 2)):
        model, placement = pin.Model(), pin.SE3(rotation, np.array([0.1, 0, 0]))
        for joint in range(6):
            model.addJoint(joint, pin.JointModelRX(), placement, f"j{joint}")
        counts.append(cpin.joint_placements(model).n_instructions())
    assert counts[0] == counts[1]
    planar = make_tree("planar")
    planar.jointPlacements[1].setIdentity()
    assert cpin.joint_placements(planar).nnz_out() == 7  # c, s, -s, c, 1, x, y


def test_models_without_joints_and_empty_frame_lists_have_no_columns() -> None:
    model = pin.Model()
    assert cpin.joint_placements(model).size_out(0) == (12, 0)
    assert cpin.frame_placements(model, []).size_out(0) == (12, 0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda arm: cpin.frame_placements(arm, ["planar_tip", "revolut_x_tip"]),
            r"frames\[1\].*did you mean 'revolute_x_tip'",
        ),
        (lambda arm: cpin.frame_jacobian(arm, arm.nframes), "frame"),
        (lambda arm: cpin.frame_placements(arm, [-1]), "frame"),
        (lambda arm: cpin.frame_jacobian(arm, "planar_tip", "locale"), "reference"),
    ],
)
def test_unknown_names_are_rejected(
    build: Callable[[pin.Model], object], message: str, arm: pin.Model
) -> None:
    with pytest.raises(UnknownNameError, match=message):
        build(arm)


def test_ambiguous_frame_names_are_rejected(arm: pin.Model) -> None:
    model = arm.copy()
    for parent, kind in ((1, pin.FrameType.OP_FRAME), (2, pin.FrameType.SENSOR)):
        model.addFrame(pin.Frame("twice", parent, 0, pin.SE3.Identity(), kind))
    with pytest.raises(InputError, match="several frames are named 'twice'"):
        cpin.frame_placements(model, ["twice"])


@pytest.mark.parametrize(
    ("installed", "message"),
    [
        ("4.10.0", r"pin 4\.1\.0, but 4\.10\.0 is installed.*pip install 'pin==4\.1\.\*'"),
        ("5.1.0", r"5\.1\.0 is installed"),
        ("4.0.3", r"4\.0\.3 is installed"),
        ("unknown", "cannot read the version 'unknown'"),
    ],
)
def test_only_patch_releases_are_compatible(installed: str, message: str) -> None:
    built, patched = {"pin": "4.1.0", "casadi": "3.8.2"}, {"pin": "4.1.12", "casadi": "3.8.2+x"}
    backends.check_versions(built, patched)
    with pytest.raises(BuildError, match=message):
        backends.check_versions(built, {**patched, "pin": installed})


def test_upstream_backend_is_used_if_available(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name in ((types.ModuleType("pinocchio.casadi"), "upstream"), (None, "compiled")):
        monkeypatch.setitem(sys.modules, "pinocchio.casadi", module)
        cpin._get_backend.cache_clear()
        assert cpin.backend_name() == name
    cpin._get_backend.cache_clear()


@pytest.mark.skipif(
    importlib.util.find_spec("pinocchio.casadi") is None,
    reason="this pinocchio has no casadi binding",
)
def test_upstream_and_compiled_backends_agree(arm: pin.Model) -> None:
    q, (v, a) = next(sample_configurations(arm)), np.random.default_rng(6).normal(size=(2, arm.nv))
    frame = arm.getFrameId("planar_tip")
    for name, arguments, inputs in (
        ("joint_placements", ([],), (q,)),
        ("joint_placements", ([2],), (q, stack_placements([arm.jointPlacements[2]]))),
        ("frame_placements", ([frame],), (q,)),
        ("frame_jacobian", (frame, 2), (q,)),
        ("rnea", (), (q, v, a)),
        ("center_of_mass", (), (q,)),
    ):
        upstream, compiled = (
            backend(name, arm, *arguments)(*inputs).full()
            for backend in (backends.build_upstream, backends.build_compiled)
        )
        np.testing.assert_allclose(upstream, compiled, atol=TOLERANCE)


def test_placements_of_joints_are_arguments() -> None:
    """One function serves all models that differ in how the given joints are placed."""
    model = make_tree("planar", "revolute_unaligned", "prismatic_y")
    function = cpin.joint_placements(model, (3, 2))
    for _ in range(3):
        for joint in (2, 3):
            model.jointPlacements[joint] = pin.SE3.Random()
        placements = stack_placements([model.jointPlacements[joint] for joint in (3, 2)])
        for q in sample_configurations(model):
            found = function(q=q, P=placements)["M"].full()
            np.testing.assert_allclose(found, compute_placements(model, q), atol=TOLERANCE)


@pytest.mark.parametrize("given", [(0,), (9,), (1, 1), "12", (1.5,)])
def test_given_joints_are_joints_of_the_model(given: Any) -> None:
    with pytest.raises(InputError, match="given"):
        cpin.joint_placements(make_tree("planar", "prismatic_y"), given)


@pytest.mark.parametrize("first", ["casadi", "pinocchio", "vkc_pin.planning.kinematics"])
def test_compiled_module_is_imported_at_first_use(first: str) -> None:
    """The order of imports does not matter."""
    code = f"""
import {first}
import sys, casadi, pinocchio, vkc_pin.planning.kinematics as cpin
assert "vkc_pin.planning.kinematics._cpin" not in sys.modules
model = pinocchio.Model()
model.addJoint(0, pinocchio.JointModelRZ(), pinocchio.SE3.Identity(), "j")
assert abs(cpin.joint_placements(model)(0.5)[0] - {np.cos(0.5)}) < 1e-12
"""
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)
