"""Compares the mass that each joint of an imported object moves with Pinocchio and MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.importing.description import Description
from vkc_pin.importing.objects.clean_up import merge_fixed_links
from vkc_pin.importing.objects.object_reading import read_object

AXES = ("1 0 0", "0 1 0", "0 0 1")


@dataclass(frozen=True)
class Body:
    """A link of a random tree, and the joint that carries it.

    Attributes:
        parent: Number of its parent.
        is_hinged: Whether a hinge carries it rather than a fixed joint.
        mass: Mass [kg]; 0: none is stated.
        has_shape: Whether it has a box of 0.1 m.
        place: Position of the joint in the parent's frame, shape (3,) [m].
        yaw: Rotation of the joint about z [rad].
        axis: Axis of the hinge.
    """

    parent: int
    is_hinged: bool
    mass: float
    has_shape: bool
    place: tuple[float, float, float]
    yaw: float
    axis: str

    @property
    def moments(self) -> tuple[float, float, float]:
        return (0.1 * self.mass, 0.15 * self.mass, 0.2 * self.mass)


@st.composite
def draw_tree(draw: st.DrawFn) -> list[Body]:
    """Draw a tree of links, of which the first is the base and at least one hinged one is solid."""
    lengths = st.floats(-0.5, 0.5).map(lambda value: round(value, 3))
    tree = [Body(-1, False, draw(st.sampled_from([0.0, 3.0])), True, (0.0, 0.0, 0.0), 0.0, AXES[2])]
    for number in range(1, draw(st.integers(2, 9))):
        tree.append(
            Body(
                parent=draw(st.integers(0, number - 1)),
                is_hinged=number == 1 or draw(st.booleans()),
                mass=draw(st.sampled_from([0.0, 0.4, 5.0, 40.0])),
                has_shape=number == 1 or draw(st.booleans()),
                place=draw(st.tuples(lengths, lengths, lengths)),
                yaw=draw(st.sampled_from([0.0, 0.7, -2.0])),
                axis=draw(st.sampled_from(AXES)),
            )
        )
    return tree


def find_moving(tree: list[Body]) -> set[int]:
    """Return the bodies whose hinges move a shape: the others are rigid with their parents."""
    moving = set()
    for number, body in enumerate(tree):
        below = number
        while body.has_shape and below >= 0:
            if tree[below].is_hinged:
                moving.add(below)
            below = tree[below].parent
    return moving


def format_urdf(tree: list[Body], hinges: set[int] | None = None) -> str:
    """Format a tree as a URDF; hinges that are not among `hinges` are fixed."""
    parts = []
    for number, body in enumerate(tree):
        shape, inertial = "", ""
        if body.has_shape:
            shape = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
        if body.mass:
            names = zip(("ixx", "iyy", "izz"), body.moments, strict=True)
            moments = " ".join(f'{name}="{value!r}"' for name, value in names)
            inertial = (
                f'<inertial><origin xyz="0.02 -0.3 0.1"/><mass value="{body.mass}"/>'
                f'<inertia ixy="0" ixz="0" iyz="0" {moments}/></inertial>'
            )
        parts.append(f'<link name="b{number}">{shape}{inertial}</link>')
        if number:
            is_hinged = body.is_hinged and (hinges is None or number in hinges)
            kind = "revolute" if is_hinged else "fixed"
            xyz = " ".join(map(str, body.place))
            parts.append(
                f'<joint name="j{number}" type="{kind}"><parent link="b{body.parent}"/>'
                f'<child link="b{number}"/><origin xyz="{xyz}" rpy="0 0 {body.yaw}"/>'
                f'<axis xyz="{body.axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
                "</joint>"
            )
    return f'<robot name="tree">{"".join(parts)}</robot>'


def format_sdf(tree: list[Body]) -> str:
    parts = []
    for number, body in enumerate(tree):
        shape, inertial, pose = "", "", ""
        if body.has_shape:
            box = "<box><size>0.1 0.1 0.1</size></box>"
            shape = f'<collision name="c"><geometry>{box}</geometry></collision>'
        if body.mass:
            names = zip(("ixx", "iyy", "izz"), body.moments, strict=True)
            moments = "".join(f"<{name}>{value!r}</{name}>" for name, value in names)
            inertial = (
                f"<inertial><pose>0.02 -0.3 0.1 0 0 0</pose><mass>{body.mass}</mass>"
                f"<inertia>{moments}</inertia></inertial>"
            )
        if number:
            values = " ".join(map(str, body.place))
            pose = f'<pose relative_to="b{body.parent}">{values} 0 0 {body.yaw}</pose>'
        parts.append(f'<link name="b{number}">{pose}{shape}{inertial}</link>')
        if number:
            kind = "revolute" if body.is_hinged else "fixed"
            limit = "<limit><lower>-1</lower><upper>1</upper></limit>"
            parts.append(
                f'<joint name="j{number}" type="{kind}"><parent>b{body.parent}</parent>'
                f"<child>b{number}</child><axis><xyz>{body.axis}</xyz>{limit}</axis></joint>"
            )
    return f'<sdf version="1.9"><model name="tree">{"".join(parts)}</model></sdf>'


def format_mjcf(tree: list[Body], hinges: set[int] | None = None, *, compiler: str = "") -> str:
    """Format a tree as an MJCF, in which shapes without a stated mass have the default density."""

    def format_body(number: int) -> str:
        body = tree[number]
        shape, inertial, joint = "", "", ""
        if body.has_shape:
            shape = '<geom type="box" size="0.05 0.05 0.05"/>'
        if body.mass:
            moments = " ".join(map(repr, body.moments))
            inertial = f'<inertial pos="0.02 -0.3 0.1" mass="{body.mass}" diaginertia="{moments}"/>'
        if body.is_hinged and (hinges is None or number in hinges):
            joint = f'<joint name="j{number}" axis="{body.axis}" range="-1 1"/>'
        below = (format_body(k) for k in range(len(tree)) if tree[k].parent == number)
        place = " ".join(map(str, body.place))
        return (
            f'<body name="b{number}" pos="{place}" euler="0 0 {body.yaw}">{joint}{inertial}{shape}'
            f"{''.join(below)}</body>"
        )

    head = f'<compiler angle="radian" boundmass="1e-14" boundinertia="1e-14" {compiler}/>'
    return f"<mujoco>{head}<worldbody>{format_body(0)}</worldbody></mujoco>"


def compute_with_pinocchio(tree: list[Body]) -> dict[str, pin.Inertia]:
    """Return the inertia that each joint carries, in its frame."""
    model = pin.buildModelFromXML(format_urdf(tree, find_moving(tree)))
    return {str(model.names[j]): model.inertias[j] for j in range(1, model.njoints)}


def compute_with_mujoco(tree: list[Body]) -> dict[str, pin.Inertia]:
    """Return the inertia that each joint carries, in its frame, fused by MuJoCo's compiler."""
    mujoco = pytest.importorskip("mujoco")
    text = format_mjcf(tree, find_moving(tree), compiler='fusestatic="true"')
    model = mujoco.MjModel.from_xml_string(text)
    found = {}
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        quaternion = pin.Quaternion(*model.body_iquat[body])
        place = pin.SE3(quaternion.matrix(), np.array(model.body_ipos[body]))
        moments = np.diag(model.body_inertia[body])
        principal = pin.Inertia(float(model.body_mass[body]), np.zeros(3), moments)
        found[str(model.joint(joint).name)] = place.act(principal)
    return found


def list_inertias(description: Description) -> dict[str, pin.Inertia]:
    return {
        joint.name: description.links[child].inertia for child, joint in description.joints.items()
    }


def assert_equal(found: Mapping[str, pin.Inertia], right: Mapping[str, pin.Inertia]) -> None:
    assert set(found) == set(right)
    for name, inertia in found.items():
        assert inertia.mass == pytest.approx(right[name].mass, abs=1e-9), name
        assert np.allclose(inertia.mass * inertia.lever, right[name].mass * right[name].lever)
        assert np.allclose(inertia.matrix(), right[name].matrix(), atol=1e-6), name


FORMATS: dict[str, tuple[Callable[[list[Body]], str], Callable[[list[Body]], object]]] = {
    "urdf": (format_urdf, compute_with_pinocchio),
    "sdf": (format_sdf, compute_with_pinocchio),
    "xml": (format_mjcf, compute_with_mujoco),
}


@pytest.mark.parametrize("ending", FORMATS)
@settings(max_examples=25, deadline=None)
@given(tree=draw_tree())
def test_every_joint_moves_the_mass_of_its_rigid_group(
    ending: str, tree: list[Body], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Chains of fixed links, links without shapes and joints that move none keep their masses."""
    write, compute = FORMATS[ending]
    if ending == "xml":
        pytest.importorskip("mujoco")
    file = tmp_path_factory.mktemp("tree") / f"tree.{ending}"
    file.write_text(write(tree))
    merged = merge_fixed_links(read_object(file))
    assert_equal(list_inertias(merged), compute(tree))  # type: ignore[arg-type]
    dead = {f"j{k}" for k, body in enumerate(tree) if body.is_hinged} - set(list_inertias(merged))
    noted = {name for name in dead if any(f"joint '{name}' moves" in n for n in merged.notes)}
    assert noted == dead


def format_box(size: str, at: str = "0 0 0") -> str:
    geometry = f'<geometry><box size="{size}"/></geometry>'
    return f'<collision><origin xyz="{at}"/>{geometry}</collision>'


def format_mass(mass: float) -> str:
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    return f'<inertial><mass value="{mass}"/>{inertia}</inertial>'


def format_vault(carried: str) -> str:
    """Format a safe whose door of 5 kg carries more, as the <joint>s and <link>s `carried` say."""
    leaf = format_box("0.02 0.58 0.7", "0 -0.3 0") + format_box("0.02 0.02 0.2", "-0.07 -0.5 0")
    return (
        f'<link name="case">{format_box("0.1 0.6 0.8", "0.1 0 0.4")}</link>'
        f'<link name="leaf">{leaf}{format_mass(5.0)}</link>{carried}'
        '<joint name="swing" type="revolute"><parent link="case"/><child link="leaf"/>'
        '<origin xyz="0.02 0.3 0.4"/><axis xyz="0 0 -1"/>'
        '<limit lower="0" upper="1.7" effort="5" velocity="1"/></joint>'
    )


def format_carried(name: str, parent: str, mass: float, kind: str = "fixed") -> str:
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>' if kind != "fixed" else ""
    return (
        f'<link name="{name}">{format_mass(mass)}</link>'
        f'<joint name="to_{name}" type="{kind}"><parent link="{parent}"/><child link="{name}"/>'
        f'<origin xyz="0 -0.35 0.1"/>{limit}</joint>'
    )


CARRIED = {
    "lead": (format_carried("lead", "leaf", 40.0), 45.0),
    "glass in a frame": (
        format_carried("frame", "leaf", 2.0) + format_carried("glass", "frame", 9.0),
        16.0,
    ),
    "bolt that moves no shape": (format_carried("bolt", "leaf", 2.3, "prismatic"), 7.3),
    "ballast of the case": (format_carried("ballast", "case", 30.0), 5.0),
}


@pytest.mark.parametrize(("carried", "mass"), CARRIED.values(), ids=CARRIED)
def test_imported_safe_weighs_as_much_as_in_its_file(
    carried: str, mass: float, tmp_path: Path
) -> None:
    (tmp_path / "safe.urdf").write_text(f'<robot name="safe">{format_vault(carried)}</robot>')
    done = vkc.importing.import_object(tmp_path / "safe.urdf", tmp_path / "safe")
    swing = done.object.model.getJointId("swing")
    assert done.object.model.inertias[swing].mass == pytest.approx(mass)
    assert any("2.3 kg move with link 'leaf'" in note for note in done.notes) == ("bolt" in carried)


def iterate_home_links() -> Iterator[str]:
    yield f'<link name="rooms">{format_box("6 0.1 2.4", "0 2 1.2")}</link>'
    yield (
        '<joint name="stands" type="fixed"><parent link="rooms"/><child link="case"/>'
        '<origin xyz="2.5 0 0"/></joint>'
    )
    yield format_vault(format_carried("glass", "leaf", 9.0))
    yield (
        f'<link name="can">{format_box("0.05 0.05 0.1", "0 0 0.05")}</link>'
        '<joint name="stood" type="floating"><parent link="rooms"/><child link="can"/></joint>'
    )
    yield format_carried("soup", "can", 0.4)


def test_parts_of_an_imported_home_weigh_as_much_as_in_its_file(tmp_path: Path) -> None:
    (tmp_path / "home.urdf").write_text(
        f'<robot name="home">{"".join(iterate_home_links())}</robot>'
    )
    done = vkc.importing.import_home(tmp_path / "home.urdf", tmp_path / "home")
    case = done.scene.objects["case"].object
    assert case.model.inertias[case.model.getJointId("swing")].mass == pytest.approx(14.0)
    assert done.scene.objects["can"].object.mass == pytest.approx(0.4)
