"""Provides scenes, grasps and short problems."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.planning.chain.collision_pairs import PhaseGeometry
from vkc_pin.planning.nlp.inspection import build
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.cache import Cache
from vkc_pin.world.collision.distances import Margins
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment, Freedom
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.task.terms import Term

CACHE = Cache()
SHORT = Options(reach_waypoints=5, turn_waypoints=3, move_waypoints=4)

# A cabinet with a swinging arm on a slanted axis, a sliding tray on the arm, and two flaps outside
# this chain.
_CABINET = """
<robot name="cabinet">
  <link name="case"><collision><geometry><box size="0.5 0.5 0.5"/></geometry></collision></link>
  <link name="arm"><collision><geometry><box size="0.3 0.05 0.05"/></geometry></collision></link>
  <link name="tray">
    <collision><origin xyz="0.1 0 0"/><geometry><box size="0.1 0.2 0.02"/></geometry></collision>
    <collision><geometry><sphere radius="0.03"/></geometry></collision>
  </link>
  <link name="knob"/>
  <link name="flap"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>
  <link name="lid"><collision><geometry><box size="0.5 0.5 0.01"/></geometry></collision></link>
  <joint name="swing" type="revolute"><parent link="case"/><child link="arm"/>
    <origin xyz="0.3 0.1 0.2" rpy="0.1 0.2 0.3"/>
    <axis xyz="0.6 0 0.8"/><limit lower="-1" upper="2" velocity="1.5" effort="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="arm"/><child link="tray"/>
    <origin xyz="0.2 0 0.1" rpy="0.4 0 0"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.3" velocity="0.4" effort="1"/></joint>
  <joint name="pin" type="fixed"><parent link="tray"/><child link="knob"/>
    <origin xyz="0.15 0 0.05" rpy="0 0.3 0"/></joint>
  <joint name="flap_hinge" type="revolute"><parent link="arm"/><child link="flap"/>
    <origin xyz="0 0 0.2"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="lid_hinge" type="revolute"><parent link="case"/><child link="lid"/>
    <origin xyz="0 0 0.3"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
</robot>"""
_CABINET_FILE = """
urdf: cabinet.urdf
joints: {swing: {acceleration: 3.0}, slide: {acceleration: 0.7}}
attachments:
  - {name: grip, link: knob, position: [0.02, 0.01, 0.03], approach: [1, 0, 0], closing: [0, 0, 1]}
"""
CABINET_STATE = {"swing": 0.3, "slide": 0.1, "flap_hinge": 0.7, "lid_hinge": -0.4}


@cache
def load_door_scene() -> Scene:
    return load_scene("door")


@cache
def load_cabinet() -> ArticulatedObject:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "cabinet.urdf").write_text(_CABINET)
        (Path(folder) / "cabinet.yaml").write_text(_CABINET_FILE)
        return load_object(Path(folder) / "cabinet.yaml")


def replace_objects(scene: Scene, objects: Mapping[str, PlacedObject]) -> Scene:
    """Return `scene` with `objects` added or replaced."""
    return dataclasses.replace(scene, objects={**scene.objects, **objects})


def replace_attachment(placed: PlacedObject, attachment: Attachment) -> PlacedObject:
    """Return `placed` with one more attachment."""
    attachments = {**placed.object.attachments, attachment.name: attachment}
    return dataclasses.replace(
        placed, object=dataclasses.replace(placed.object, attachments=attachments)
    )


@cache
def make_full_scene() -> Scene:
    """Return the door's room with a drawer and a cabinet that has attachments of every kind."""
    scene = load_door_scene()
    drawer = load_scene("drawer").objects["drawer"]
    state = np.array([CABINET_STATE[name] for name in load_cabinet().coordinates.names])
    case = PlacedObject(
        "cabinet",
        load_cabinet(),
        pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 0.8), np.array([-1.0, 1.2, 0.4])),
        state,
    )
    grip = load_cabinet().attachments["grip"]
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    turns = tuple(
        Freedom(f"_{name}", "revolute", unit, -0.7, 0.6)
        for name, unit in zip("xyz", np.eye(3), strict=True)
    )
    sleeve = (
        Freedom("_slide", "prismatic", axis, -0.05, 0.08),
        Freedom("_turn", "revolute", axis, -0.5, 0.9),
    )
    wheel = (
        Freedom("_around", "revolute", axis, -2.0, 2.0, np.array([0.1, -0.2, 0.05])),
        Freedom("_tilt", "revolute", turns[1].axis, -0.5, 0.5),
    )
    face = (
        *(
            Freedom(f"_{name}", "prismatic", unit, -0.1, 0.1)
            for name, unit in zip("xy", np.eye(3), strict=False)
        ),
        turns[2],
    )
    for attachment in (
        dataclasses.replace(
            grip,
            name="rail",
            joint="prismatic",
            freedoms=(Freedom("", "prismatic", axis, -0.05, 0.08),),
        ),
        dataclasses.replace(
            grip, name="bar", joint="revolute", freedoms=(Freedom("", "revolute", axis, -0.5, 0.9),)
        ),
        dataclasses.replace(grip, name="ball", joint="spherical", freedoms=turns),
        dataclasses.replace(
            grip, name="sleeve", joint="cylindrical", freedoms=sleeve, standoff=0.02
        ),
        dataclasses.replace(grip, name="socket", joint="spherical", freedoms=turns, standoff=0.04),
        dataclasses.replace(grip, name="spike", standoff=0.03),
        dataclasses.replace(grip, name="wheel", joint="listed", freedoms=wheel, standoff=0.02),
        dataclasses.replace(grip, name="face", joint="listed", freedoms=face, standoff=0.01),
    ):
        case = replace_attachment(case, attachment)
    return replace_objects(scene, {"drawer": drawer, "cabinet": case})


def sample_configurations(
    lower: np.ndarray,
    upper: np.ndarray,
    count: int,
    rng: np.random.Generator,
    *,
    arena: float = 2.0,
) -> np.ndarray:
    """Return configurations within limits, (count, n), the base within `arena`, at any heading."""
    low = np.maximum(lower, -np.pi)
    high = np.minimum(upper, np.pi)
    low[:2] = -arena
    high[:2] = arena
    return rng.uniform(low, high, (count, len(low)))


def make_all_pairs(part: PhaseGeometry) -> pin.GeometryModel:
    """Return a phase's geometry as a Pinocchio model with all pairs, without culling."""
    geometry = pin.GeometryModel()
    for shape in part.shapes:
        geometry.addGeometryObject(shape)
    for first, second in part.pairs.tolist():
        geometry.addCollisionPair(pin.CollisionPair(first, second))
    return geometry


def compute_grasp_error(scene: Scene, row: np.ndarray, hinge: float, knob: float) -> float:
    """Return the largest coordinate of the error between tool and grasp, by numeric Pinocchio."""
    placed = scene.objects["door"].with_state({"hinge": hinge, "knob": knob})
    attachment = placed.object.attachment("handle")
    tool = dataclasses.replace(scene, start=row[:9]).tool_placement()
    error = tool.inverse() * placed.link_placement(attachment.link) * attachment.placement
    return float(np.abs(pin.log6(error).vector).max())


def make_program(
    scene: Scene,
    steps: Sequence[Step],
    *,
    options: Options | None = None,
    terms: Sequence[Term] = (),
) -> TrajectoryProblem:
    """Return the program of `steps`; symbolic programs are cached per process."""
    return build(scene, steps, options=options, terms=terms, cache=CACHE)


def get_margins(part: PhaseGeometry, pairs: np.ndarray, waypoints: np.ndarray) -> np.ndarray:
    """Return margins of pairs at waypoints, shape (n,) [m], without `margin_regions`."""
    margins = Margins(part.margins, part.reduced_margins)
    return margins.compute_margins(pairs, waypoints, np.empty((1, 0)), np.zeros(len(pairs), int))
