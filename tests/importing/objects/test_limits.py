"""Tests the limits that are chosen for joints without limits."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import coal
import numpy as np
import pytest
from helpers.descriptions import make_description, make_joint, make_part
from helpers.partnet import write_partnet_object

import vkc_pin as vkc
from vkc_pin.importing.description import Description, Link
from vkc_pin.importing.objects.clean_up import compute_bounds, load_surfaces, merge_fixed_links
from vkc_pin.importing.objects.limits import add_missing_limits
from vkc_pin.importing.objects.object_reading import read_object


def compute_box(description: Description, **values: float) -> np.ndarray:
    return np.array(compute_bounds(description, load_surfaces(description), values))


def test_missing_limits_open_outwards(tmp_path: Path) -> None:
    found = merge_fixed_links(read_object(write_partnet_object(tmp_path)))
    limited = add_missing_limits(found)
    low, high = limited.joints["link_1"].limits or (0.0, 0.0)
    assert sorted(map(abs, (low, high))) == pytest.approx([0.0, np.pi / 2])
    depths = [np.ptp(compute_box(limited, joint_1=value), axis=0)[0] for value in (0.0, low + high)]
    assert depths[1] > depths[0] + 0.1  # the door opens to the front, along x
    assert any("joint_1" in note and "1.57" in note for note in limited.notes)
    assert limited.joints["link_0"].limits == (0.0, 0.36)
    # 1.57 read as degrees
    narrow = dataclasses.replace(limited.joints["link_1"], limits=(0.0, 0.0274))
    degrees = dataclasses.replace(limited, joints={**limited.joints, "link_1": narrow})
    notes = add_missing_limits(degrees).notes
    assert any("only 1.6°" in note or "only 2°" in note for note in notes)


# A back panel, and a leaf or drawer 0.58 wide in front of it, with a bar
PANEL = "0.02 0.6 0.8"
FRONT = ("0.02 0.58 0.7", "0.02 0.02 0.2")
DRAWER = "0.18 0.58 0.7"


def format_urdf(kind: str, limit: str) -> str:
    size = FRONT[0] if kind == "revolute" else DRAWER
    axis = "0 0 -1" if kind == "revolute" else "-1 0 0"

    def format_box(size: str, at: str) -> str:
        shape = f'<geometry><box size="{size}"/></geometry>'
        return f'<collision><origin xyz="{at}"/>{shape}</collision>'

    return (
        f'<robot name="r"><link name="case">{format_box(PANEL, "0.2 0 0.4")}</link>'
        f'<link name="leaf">{format_box(size, "0 -0.3 0")}{format_box(FRONT[1], "-0.15 -0.5 0")}'
        f'</link><joint name="turn" type="{kind}"><parent link="case"/><child link="leaf"/>'
        f'<origin xyz="-0.02 0.3 0.4"/><axis xyz="{axis}"/>{limit}</joint></robot>'
    )


def format_sdf(kind: str, limit: str) -> str:
    size = FRONT[0] if kind == "revolute" else DRAWER
    axis = "0 0 -1" if kind == "revolute" else "-1 0 0"

    def format_box(name: str, size: str, at: str) -> str:
        shape = f"<geometry><box><size>{size}</size></box></geometry>"
        return f'<collision name="{name}"><pose>{at} 0 0 0</pose>{shape}</collision>'

    return (
        '<sdf version="1.9"><model name="m">'
        f'<link name="case">{format_box("c", PANEL, "0.2 0 0.4")}</link>'
        f'<link name="leaf"><pose>-0.02 0.3 0.4 0 0 0</pose>{format_box("p", size, "0 -0.3 0")}'
        f'{format_box("b", FRONT[1], "-0.15 -0.5 0")}</link><joint name="turn" type="{kind}">'
        f"<parent>case</parent><child>leaf</child><axis><xyz>{axis}</xyz>{limit}</axis></joint>"
        "</model></sdf>"
    )


def format_mjcf(kind: str, attributes: str) -> str:
    size = FRONT[0] if kind == "revolute" else DRAWER
    kind, axis = ("hinge", "0 0 -1") if kind == "revolute" else ("slide", "-1 0 0")

    def format_box(size: str, at: str) -> str:
        half = " ".join(str(float(value) / 2.0) for value in size.split())
        return f'<geom type="box" size="{half}" pos="{at}"/>'

    return (
        f'<mujoco><worldbody><body name="case">{format_box(PANEL, "0.2 0 0.4")}'
        f'<body name="leaf" pos="-0.02 0.3 0.4">'
        f'<joint name="turn" type="{kind}" axis="{axis}" {attributes}/>'
        f"{format_box(size, '0 -0.3 0')}{format_box(FRONT[1], '-0.15 -0.5 0')}"
        "</body></body></worldbody></mujoco>"
    )


UNLIMITED = {
    "urdf without limit": ("a.urdf", format_urdf, ""),
    "urdf of effort alone": ("a.urdf", format_urdf, '<limit effort="5" velocity="1"/>'),
    "urdf of 1e16": ("a.urdf", format_urdf, '<limit lower="-1e16" upper="1e16" effort="1"/>'),
    "urdf of the largest float": (
        "a.urdf",
        format_urdf,
        '<limit lower="-1.79769e308" upper="1.79769e308" effort="1" velocity="1"/>',
    ),
    "sdf without limit": ("a.sdf", format_sdf, ""),
    "sdf of effort alone": ("a.sdf", format_sdf, "<limit><effort>5</effort></limit>"),
    "sdf of 1e16": ("a.sdf", format_sdf, "<limit><lower>-1e16</lower><upper>1e16</upper></limit>"),
    "sdf of inf": ("a.sdf", format_sdf, "<limit><lower>-inf</lower><upper>inf</upper></limit>"),
    "mjcf without range": ("a.xml", format_mjcf, ""),
    "mjcf with a range that does not apply": (
        "a.xml",
        format_mjcf,
        'range="-30 30" limited="false"',
    ),
    "mjcf of 1e16": ("a.xml", format_mjcf, 'range="-1e16 1e16"'),
}


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize(("name", "write", "limit"), UNLIMITED.values(), ids=UNLIMITED)
def test_every_format_yields_the_same_limits(
    name: str, write: object, limit: str, kind: str, tmp_path: Path
) -> None:
    """The leaf opens away from its back panel, the drawer by 0.8 of its depth."""
    if name.endswith(".xml"):
        pytest.importorskip("mujoco")
    (tmp_path / name).write_text(write(kind, limit))  # type: ignore[operator]
    done = vkc.importing.import_object(tmp_path / name, tmp_path / "out")
    right = np.pi / 2.0 if kind == "revolute" else 0.8 * (0.16 + 0.09)
    assert (*done.object.lower, *done.object.upper) == pytest.approx((0.0, right))
    (note,) = (note for note in done.notes if "'turn' states no limits" in note)
    assert "away from centre" in note
    assert done.proposals.find_goal("turn") == pytest.approx(right)


def test_joints_that_are_said_to_turn_without_end_stay_endless(tmp_path: Path) -> None:
    for name, text in (
        ("a.urdf", format_urdf("continuous", "")),
        ("a.sdf", format_sdf("continuous", "")),
    ):
        (tmp_path / name).write_text(text)
        done = vkc.importing.import_object(tmp_path / name, tmp_path / f"out_{name}")
        assert np.isinf(done.object.upper).all(), name


def test_hinges_of_a_home_get_the_same_limits(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    text = format_mjcf("revolute", "").replace('name="case"', 'name="case" pos="2 0 0"')
    wall = '<geom type="box" size="3 0.05 1.2" pos="0 2 1.2"/></worldbody>'
    (tmp_path / "home.xml").write_text(text.replace("</worldbody>", wall))
    home = vkc.importing.import_home(tmp_path / "home.xml", tmp_path / "out")
    case = home.scene.objects["case"].object
    assert (*case.lower, *case.upper) == pytest.approx((0.0, np.pi / 2.0))
    assert any("case: joint 'turn' states no limits" in note for note in home.notes)


def make_boxes(*boxes: tuple[Sequence[float], Sequence[float]]) -> tuple:
    """Return boxes, given by their sizes and places."""
    return tuple(make_part(size=tuple(size), at=at) for size, at in boxes)


def compute_depth(description: Description, joint: str, value: float) -> float:
    """Return the largest depth of the leaf in the case at a position of a joint [m]."""
    placements = description.compute_placements({joint: value})
    depths = [0.0]
    for moved in description.links["leaf"].collision:
        for fixed in description.links["case"].collision:
            shapes, places = zip(
                *(
                    (coal.Box(*part.size), placements[name] * part.placement)
                    for name, part in (("leaf", moved), ("case", fixed))
                ),
                strict=True,
            )
            transforms = [coal.Transform3s(p.rotation, p.translation) for p in places]
            distance = coal.distance(
                shapes[0],
                transforms[0],
                shapes[1],
                transforms[1],
                coal.DistanceRequest(),
                coal.DistanceResult(),
            )
            depths.append(-distance)
    return max(depths)


LEAF = ((0.02, 0.58, 0.7), (0.0, -0.3, 0.0))  # in the frame of a hinge at its edge
HINGE = (-0.02, 0.3, 0.4)
BODY = ((0.6, 0.6, 0.8), (0.32, 0.0, 0.4))  # solid, behind the leaf
TRAY = ((0.4, 0.5, 0.1), (0.0, 0.0, 0.0))
CARCASS = [  # hollow, open to the front, with the tray in its centre
    ((0.42, 0.02, 0.2), (0.0, 0.29, 0.0)),
    ((0.42, 0.02, 0.2), (0.0, -0.29, 0.0)),
    ((0.42, 0.6, 0.02), (0.0, 0.0, 0.11)),
    ((0.42, 0.6, 0.02), (0.0, 0.0, -0.11)),
]
SHELF = ((1.0, 0.6, 0.02), (-0.6, 0.0, 1.2))  # moves the centre in front of the leaf
SCREEN = ((0.02, 0.6, 0.8), (-0.3, 0.0, 0.4))  # in front of the leaf

DIRECTIONS = {
    # case, leaf, place, axis, slides; signs of the limits, end
    "back panel": ([((0.02, 0.6, 0.8), (0.2, 0, 0.4))], LEAF, HINGE, (0, 0, -1), (0.0, np.pi / 2)),
    "axis up": ([((0.02, 0.6, 0.8), (0.2, 0, 0.4))], LEAF, HINGE, (0, 0, 1), (-np.pi / 2, 0.0)),
    "centre in front": ([BODY, SHELF], LEAF, HINGE, (0, 0, -1), (0.0, np.pi / 2)),
    "screen in front": ([BODY, SCREEN], LEAF, HINGE, (0, 0, -1), (0.0, np.radians(25.0))),
    "drawer with a back at x": (
        [*CARCASS, ((0.02, 0.6, 0.24), (0.22, 0.0, 0.0))],
        TRAY,
        (0.0, 0.0, 0.0),
        (1, 0, 0),
        (-0.32, 0.0),
    ),
    "drawer with a back at -x": (
        [*CARCASS, ((0.02, 0.6, 0.24), (-0.22, 0.0, 0.0))],
        TRAY,
        (0.0, 0.0, 0.0),
        (1, 0, 0),
        (0.0, 0.32),
    ),
    "drawer in a solid body": (
        [((0.6, 0.8, 0.4), (0.15, 0.0, 0.0))],
        TRAY,
        (0.0, 0.0, 0.0),
        (1, 0, 0),
        (-0.32, 0.0),
    ),
}


@pytest.mark.parametrize(
    ("case", "leaf", "place", "axis", "right"), DIRECTIONS.values(), ids=DIRECTIONS
)
def test_parts_open_where_the_object_leaves_room(
    case: list, leaf: tuple, place: tuple, axis: tuple, right: tuple[float, float]
) -> None:
    kind = "revolute" if leaf is LEAF else "prismatic"
    joint = make_joint("case", "leaf", kind, place, None, axis=np.array(axis, float))
    links = [Link("case", (), make_boxes(*case)), Link("leaf", (), make_boxes(leaf))]
    found = add_missing_limits(make_description(links, [joint]))
    limits = found.joints["leaf"].limits
    assert limits == pytest.approx(right, abs=1e-9)
    assert limits is not None
    closed = compute_depth(found, "to_leaf", 0.0)
    for value in np.linspace(*limits, 50):
        assert compute_depth(found, "to_leaf", value) < closed + 0.03
    assert any("'to_leaf' states no limits" in note for note in found.notes)


def test_notes_name_what_is_in_the_way() -> None:
    """With a screen in front of the leaf it opens up to the screen, or else backwards."""
    joint = make_joint("case", "leaf", "revolute", HINGE, None, axis=np.array([0.0, 0.0, -1.0]))

    def choose(*case: tuple[Sequence[float], Sequence[float]]) -> str:
        links = [Link("case", (), make_boxes(*case)), Link("leaf", (), make_boxes(LEAF))]
        return add_missing_limits(make_description(links, [joint])).notes[-1]

    assert choose(BODY, SCREEN).endswith("away from centre, up to 'case'")
    assert "towards the centre, since 'case' is in the other direction" in choose(
        ((0.02, 0.6, 0.8), (-0.1, 0.0, 0.4)), SHELF, ((0.02, 1.0, 0.02), (1.4, 0.0, 0.4))
    )


def test_limits_that_only_one_end_states_stop_at_other_parts() -> None:
    """A leaf that opens from 0.1 rad meets a screen after 25°."""
    axis = np.array([0.0, 0.0, -1.0])
    joint = make_joint("case", "leaf", "revolute", HINGE, (0.1, np.inf), axis=axis)
    links = [Link("case", (), make_boxes(BODY, SCREEN)), Link("leaf", (), make_boxes(LEAF))]
    found = add_missing_limits(make_description(links, [joint]))
    low, high = found.joints["leaf"].limits or (0.0, 0.0)
    assert low == 0.1
    assert np.radians(20.0) < high < np.radians(30.0)
    assert found.notes[-1].endswith("assumed, up to 'case'")


def test_shapes_that_overlap_everywhere_do_not_stop_a_joint() -> None:
    """A stopper between the leaves meets the leaf on both sides at once."""
    joint = make_joint("case", "leaf", "revolute", HINGE, None, axis=np.array([0.0, 0.0, -1.0]))
    around = [((0.05, 0.6, 0.8), (x, 0.0, 0.4)) for x in (-0.06, 0.02)]
    links = [Link("case", (), make_boxes(*around)), Link("leaf", (), make_boxes(LEAF))]
    found = add_missing_limits(make_description(links, [joint]))
    assert np.ptp(found.joints["leaf"].limits or (0.0, 0.0)) == pytest.approx(np.pi / 2.0)
