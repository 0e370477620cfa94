"""Plans in one room that is described by hand, and as maps, clouds and files have it."""

from __future__ import annotations

import functools
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pinocchio as pin
import trimesh
from PIL import Image

import vkc_pin as vkc
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    compute_quartiles,
    count,
    format_decimal,
    format_table,
    join_sections,
    select,
)
from vkc_pin.importing.homes.home_import import import_home
from vkc_pin.planning.plan import Plan
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene

ROOM = "corridor_door"
"""The room: five boxes of up to 10 m, 2.06 m high, around a corridor with a door."""
STEPS = (vkc.Actuate("door", {"hinge": 1.5}),)
_CELL = 0.05  # [m] of maps and octrees
_MARGIN = 0.5  # [m] of a map around the room
_FREE = 254  # brightness of a free cell of a map


@dataclass(frozen=True)
class Room:
    """The room as a source has it.

    Attributes:
        scene: The scene, with the start and the door of the one that is described by hand.
        seconds: Time of the import [s].
        recognised: Numbers of obstacles, points or pieces, in words.
    """

    scene: Scene
    seconds: float
    recognised: str


@functools.cache
def load_twin() -> Scene:
    """Return the room as it is described by hand."""
    return vkc.load_scene(ROOM)


def list_boxes() -> Iterator[tuple[str, Floats, Floats]]:
    """Yield name, size and centre, shape (3,) each [m], of the room's walls and blocks."""
    for item in load_twin().document["obstacles"]:
        yield item["name"], np.array(item["size"]), np.array(item["position"])


def _replace_obstacles(obstacles: Sequence[Mapping[str, Any]], folder: Path) -> Scene:
    """Return the room with other obstacles, whose files are in a folder."""
    document = load_twin().document
    document["obstacles"] = obstacles
    return Scene.from_document(document, folder)


def _make_bare_room() -> Scene:
    """Return the room without walls and blocks."""
    return _replace_obstacles([], load_twin().folder)


def _import_room(file: Path) -> tuple[Scene, Scene]:
    """Return the room with the obstacles of a file, and the imported home."""
    home = import_home(file, file.parent / "imported").scene
    return _replace_obstacles(home.document["obstacles"], home.folder), home


def make_map(folder: Path) -> tuple[Scene, str]:
    """Draw the walls as a map of map_server, and plan on it."""
    x_min, x_max, y_min, y_max = load_twin().arena
    low = np.array([x_min, y_min]) - _MARGIN
    cells = np.ceil((np.array([x_max, y_max]) + _MARGIN - low) / _CELL).astype(int)
    centres = [low[axis] + (np.arange(cells[axis]) + 0.5) * _CELL for axis in range(2)]
    image = np.full((cells[1], cells[0]), _FREE, np.uint8)
    for _, size, position in list_boxes():
        inside = []
        for axis in range(2):
            inside.append(np.abs(centres[axis] - position[axis]) <= size[axis] / 2.0)
        image[np.outer(inside[1], inside[0])] = 0
    Image.fromarray(image[::-1]).save(folder / "map.pgm")
    (folder / "map.yaml").write_text(
        f"image: map.pgm\nresolution: {_CELL}\norigin: [{low[0]}, {low[1]}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    height = max(size[2] for _, size, _ in list_boxes())
    on_map = _make_bare_room().with_map(folder / "map.yaml", height=float(height))
    return on_map, f"{len(on_map.obstacles) - 1} boxes"


def sample_points(spacing: float) -> Floats:
    """Return points on the surfaces of walls and blocks, shape (N, 3) [m], at a distance [m]."""
    found = []
    for _, size, position in list_boxes():
        box = trimesh.creation.box(size)
        number = int(box.area / spacing**2)
        points, _ = trimesh.sample.sample_surface(box, number, seed=0)
        found.append(np.asarray(points) + position)
    return np.concatenate(found)


def make_cloud(_: Path, spacing: float) -> tuple[Scene, str]:
    """Plan among points on the surfaces, as depth cameras measure them."""
    # Random points leave gaps of more than their mean distance.
    seen = _make_bare_room().with_points(sample_points(spacing), radius=spacing)
    counts = seen.point_counts["points"]
    removed = sum(counts) - counts.kept
    return seen, f"{counts.kept} points, {removed} removed"


def make_octree(folder: Path) -> tuple[Scene, str]:
    """Plan in an octree of OctoMap that the points fill."""
    import pyoctomap  # type: ignore[import-untyped]

    tree = pyoctomap.OcTree(_CELL)
    cells = np.unique(np.floor(sample_points(_CELL / 2.0) / _CELL), axis=0)
    for cell in cells:
        tree.updateNode(((cell + 0.5) * _CELL).tolist(), True)
    tree.updateInnerOccupancy()
    tree.writeBinary(str(folder / "room.bt"))
    read = vkc.read_points(folder / "room.bt")
    assert read.radius is not None
    seen = _make_bare_room().with_points(read.points, radius=read.radius)
    return seen, f"{len(read.points)} cells"


def make_planning_scene(folder: Path) -> tuple[Scene, str]:
    """Write a planning scene of MoveIt, and import it."""
    lines = [ROOM]
    for name, size, position in list_boxes():
        numbers = [" ".join(f"{value:.9g}" for value in values) for values in (position, size)]
        lines += [f"* {name}", numbers[0], "0 0 0 1", "1", "box", numbers[1]]
        lines += ["0 0 0", "0 0 0 1", "0 0 0 0", "0"]
    (folder / "room.scene").write_text("\n".join([*lines, ".", ""]))
    room, home = _import_room(folder / "room.scene")
    return room, f"{len(home.obstacle_names)} obstacles"


def make_mesh(folder: Path) -> tuple[Scene, str]:
    """Write the room as one mesh of many triangles, and import it."""
    parts = []
    for _, size, position in list_boxes():
        box = trimesh.creation.box(size, pin.SE3(np.eye(3), position).homogeneous)
        parts.append(box.subdivide_to_size(0.4))
    mesh = trimesh.util.concatenate(parts)
    mesh.export(folder / "room.ply")
    room, home = _import_room(folder / "room.ply")
    return room, f"{len(home.obstacles)} pieces of {len(mesh.faces)} triangles"


def make_stage(folder: Path) -> tuple[Scene, str]:
    """Write the room as a stage of USD, and import it."""
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.CreateNew(str(folder / "room.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for name, size, position in list_boxes():
        cube = UsdGeom.Cube.Define(stage, f"/room/{name}")
        cube.GetSizeAttr().Set(1.0)
        place = UsdGeom.XformCommonAPI(cube)
        place.SetTranslate(Gf.Vec3d(*position.tolist()))
        place.SetScale(Gf.Vec3f(*size.tolist()))
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    stage.GetRootLayer().Save()
    room, home = _import_room(folder / "room.usda")
    return room, f"{len(home.obstacle_names)} obstacles"


SOURCES: Mapping[str, Callable[[Path], tuple[Scene, str]]] = {
    "map": make_map,
    "cloud_50_mm": functools.partial(make_cloud, spacing=0.05),
    "cloud_20_mm": functools.partial(make_cloud, spacing=0.02),
    "octree": make_octree,
    "moveit": make_planning_scene,
    "mesh": make_mesh,
    "usd": make_stage,
}
"""Name of a source → function that writes it to a folder, and imports it."""


@functools.cache
def make_room(source: str) -> Room:
    """Return the room as a source has it; once per process."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        scene, recognised = SOURCES[source](Path(folder))
        return Room(scene, time.perf_counter() - began, recognised)


def run(
    *,
    out: str | Path,
    starts: int,
    seed: int,
    sources: Sequence[str] | None = None,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        starts: Number of random starts per source.
        seed: Random seed of starts and planning.
        sources: Some of `SOURCES`. Default: all.
    """
    names = runner.select_names(
        "source", tuple(SOURCES) if sources is None else sources, tuple(SOURCES)
    )
    settings = {
        "benchmark": "worlds",
        "seed": seed,
        "starts": starts,
        "sources": names,
        **LIMITS,
    }
    specs = []
    for number, name in enumerate(names):
        for start in range(starts):
            key = f"{number}/{start:04d}"
            specs.append({"key": key, "source": name, "number": start, "seed": seed})
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown."""
    about = result["meta"]
    rows = []
    for source in about["sources"]:
        own = select(result["trials"], source=source)
        ratios = [record["ratio"] for record in own if record["ratio"] is not None]
        quartiles = compute_quartiles(ratios)
        seconds = own[0]["import_time"] if own else None
        rows.append(
            [
                source,
                "–" if seconds is None else format_decimal(seconds),
                own[0]["recognised"] if own else "–",
                count(own),
                *map(format_decimal, quartiles),
            ]
        )
    head = ["source", "import [s]", "recognised", "success", "first quartile", "ratio", "third"]
    return join_sections(
        about,
        "# One room from several sources",
        f"{about['starts']} random starts in `{ROOM}`, seed {about['seed']}. {JUDGED} Ratios are "
        "those of planning times to the room that is described by hand, with the same start, the "
        "other plan directly before. Imports include writing the file.",
        format_table(head, rows),
    )


def _record(spec: dict[str, Any]) -> Record:
    """Plan from one start, in the room by hand and in that of the source."""
    room = make_room(spec["source"])
    rng = np.random.default_rng([spec["seed"], spec["number"]])
    start = load_twin().sample_start(rng).start
    _warm(spec["source"], spec["seed"])
    by_hand = _plan(load_twin(), start, spec["seed"])
    found = _plan(room.scene, start, spec["seed"])
    ratio = None
    if by_hand.success and found.success:
        ratio = found.metrics["planning_time"] / by_hand.metrics["planning_time"]
    return trial(
        found,
        method="VKC",
        seed=spec["seed"],
        source=spec["source"],
        number=spec["number"],
        import_time=room.seconds,
        recognised=room.recognised,
        twin=by_hand.success,
        ratio=ratio,
    )


def _plan(scene: Scene, start: Floats, seed: int) -> Plan:
    placed = scene.with_start(base=start[:3], arm=start[3:])
    return vkc.plan(placed, STEPS, seed=seed, **LIMITS)


@functools.cache
def _warm(source: str, seed: int) -> None:
    """Plan in both rooms once in this process, to exclude one-time costs from times."""
    for scene in (load_twin(), make_room(source).scene):
        _plan(scene, load_twin().start, seed)
