"""That many obstacles cost little, and that what is left out for it never matters: against all pairs, asked one by one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import STICK, box, lifted, room, table
from helpers.clutter import cluttered, cluttered_room
from helpers.motions import brute_force, pair_names, wander, whirl
from helpers.small_problems import SHORT, all_pairs, program_of, random_configurations
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.benchmarks.scale import crowded
from vkc_pin.planning.base_paths.base_clearance import MovingShapes
from vkc_pin.planning.chain import easing
from vkc_pin.planning.chain.contacts import ContactModel
from vkc_pin.planning.chain.phase_geometry import PhaseGeometry
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.validation.distances import CollisionShapes, PlacedShapes, bound_displacements
from vkc_pin.validation.pairs import PairTable
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.sweep import _Sweep, sweep
from vkc_pin.visualization.plots.clearance import compute_clearance_curves
from vkc_pin.world.collision.clearances import Clearances, ClosePairs
from vkc_pin.world.collision.shapes import count_distance_queries
from vkc_pin.world.models import shapes as geometry
from vkc_pin.world.models.shapes import compute_clearance, compute_shape_distance
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Step
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

SEEDS = st.integers(0, 2**32 - 1)
POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))
COAL = 2e-5  # [m] by which answers of coal differ that it came to from different guesses


class Counter:
    """Counts how often coal is asked for a distance, from Python or in compiled code."""

    def __init__(self) -> None:
        self.asked = 0

    @contextmanager
    def counting(self, patch: pytest.MonkeyPatch) -> Iterator[None]:
        real, counter, before = coal.distance, self, count_distance_queries()

        def distance(*arguments: Any) -> float:
            counter.asked += 1
            return real(*arguments)

        with patch.context() as context:
            context.setattr(coal, "distance", distance)
            yield
        self.asked += count_distance_queries() - before


# --- what it costs
# --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plans() -> dict[int, tuple[Plan, int]]:
    """Return the plans of opening the door among 30 and 1000 obstacles, and how many distances each took."""
    found = {}
    for count in (30, 1000):
        counter, scene = Counter(), crowded(count)
        with counter.counting(pytest.MonkeyPatch()):
            result = plan(scene, [Actuate("door", {"hinge": 1.2})])
        found[count] = result, counter.asked
    return found


def test_distances_asked_for_hardly_depend_on_the_number_of_obstacles(
    plans: dict[int, tuple[Plan, int]],
) -> None:
    (few, asked_few), (many, asked_many) = plans[30], plans[1000]
    assert few.success
    assert many.success
    assert many.metrics["rounds"] <= 2 * few.metrics["rounds"]
    assert asked_few > 1000
    assert asked_many <= 2 * asked_few
    pairs = sum(len(part.pairs) for part in program_of(many.scene, many.steps).contacts.phases)
    assert asked_many < pairs  # at hundreds of configurations


def test_the_floor_of_the_base_asks_for_few(plans: dict[int, tuple[Plan, int]]) -> None:
    counts = []
    for count in (30, 1000):
        counter = Counter()
        with counter.counting(pytest.MonkeyPatch()):
            assert plan(plans[count][0].scene, [GoTo(1.5, -0.6)], initialization="astar").success
        counts.append(counter.asked)
    assert counts[1] <= 2 * counts[0]


def test_pictures_of_clearance_ask_for_few(plans: dict[int, tuple[Plan, int]]) -> None:
    found, counts = [], []
    for result, _ in plans.values():
        counter, times = Counter(), result.trajectory.times
        with counter.counting(pytest.MonkeyPatch()):
            found.append(compute_clearance_curves(result.scene, result.trajectory, times))
        counts.append(counter.asked / len(times))
    assert [curve.name for curve in found[0]] == [curve.name for curve in found[1]]
    assert max(counts) < 200  # at every moment, of 26,000 pairs


# --- contacts
# -------------------------------------------------------------------------------------------------------


def all_distances(problem: TrajectoryProblem, part: PhaseGeometry, z: np.ndarray) -> np.ndarray:
    """Return the signed distance of every pair at every configuration, shape (W, P), by Pinocchio without culling."""
    geometry, model = all_pairs(part), problem.chain.model
    data, placed = model.createData(), pin.GeometryData(geometry)
    for request in placed.distanceRequests:
        request.gjk_tolerance = 1e-8
    distances = np.empty((len(z), len(geometry.collisionPairs)))
    for row, q in enumerate(problem.chain.coordinates.q(z)):
        pin.updateGeometryPlacements(model, data, geometry, placed, q)
        pin.computeDistances(geometry, placed)
        distances[row] = [result.min_distance for result in placed.distanceResults]
    return distances


def check_contacts(
    problem: TrajectoryProblem,
    model: ContactModel,
    phase: int,
    rng: np.random.Generator,
    *,
    reach: float,
    nearest: int | None,
) -> None:
    """All closer than `reach`, or the nearest of them: none missing, none twice, with coal's distances, in the right order."""
    z = random_configurations(problem.chain.lower, problem.chain.upper, 8, rng)
    part, waypoints = model.phases[phase], np.full(len(z), problem.ends[phase])
    distances = all_distances(problem, part, z)
    contacts = model.evaluate(z, waypoints, reach=reach, nearest=nearest)
    number = {tuple(pair): k for k, pair in enumerate(part.pairs.tolist())}
    which = np.array([number[tuple(pair)] for pair in contacts.pair.tolist()], int)
    every, same = np.arange(len(part.pairs)), np.full(len(part.pairs), problem.ends[phase])
    margins = np.array(
        [
            part.margin_table.compute_margins(every, same, z, np.full(len(every), row))
            for row in range(len(z))
        ]
    )
    assert len(set(zip(contacts.waypoint.tolist(), which.tolist(), strict=True))) == len(which)
    np.testing.assert_allclose(
        contacts.distance, distances[contacts.waypoint, which], rtol=0.0, atol=COAL
    )
    np.testing.assert_array_equal(contacts.margin, margins[contacts.waypoint, which])
    for row in range(len(z)):
        mine = (
            contacts.distance[contacts.waypoint == row] - contacts.margin[contacts.waypoint == row]
        )
        assert np.all(np.diff(mine) >= 0.0)
        asked = (distances[row] < reach) & (margins[row] > -np.inf)
        lack = np.sort((distances[row] - margins[row])[asked])[:nearest]
        sure = (
            np.abs(distances[row] - reach) > COAL
        ).all()  # a pair just at the reach may count or not
        assert not sure or len(mine) == len(lack)
        np.testing.assert_allclose(mine[: len(lack)], lack[: len(mine)], rtol=0.0, atol=COAL)


REACHES, NUMBERS = st.sampled_from([0.0, 0.02, 0.25, 1.0]), st.sampled_from([None, 1, 6])


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([0, 3, 40, 150]), REACHES, NUMBERS)
def test_contacts_are_those_among_all_pairs(
    seed: int, count: int, reach: float, nearest: int | None
) -> None:
    problem = program_of(cluttered(seed, count), [Actuate("door", {"hinge": 1.2})], options=SHORT)
    rng = np.random.default_rng(seed)
    for phase in (0, 2):
        check_contacts(problem, problem.contacts, phase, rng, reach=reach, nearest=nearest)


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.sampled_from([0, 1, 60]), REACHES, NUMBERS)
def test_contacts_of_what_is_carried_are_those_among_all_pairs(
    seed: int, count: int, reach: float, nearest: int | None
) -> None:
    """Of a stick in the hand, of a ball on its tip, and of what the motion leaves somewhere."""
    steps = [
        Grasp("stick"),
        Grasp("ball", "pull", "stick.tip"),
        Reach(POSE),
        Release("ball"),
        GoTo(0.0, 0.0),
    ]
    problem = program_of(cluttered_room(seed, count), steps, options=SHORT)
    rng = np.random.default_rng(seed)
    z = random_configurations(problem.chain.lower, problem.chain.upper, problem.segments, rng)
    model = problem.contacts.with_released_objects(z)
    assert [len(phase.held) for phase in problem.task.phases] == [0, 1, 2, 1]
    for phase in range(4):
        check_contacts(problem, model, phase, rng, reach=reach, nearest=nearest)


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.sampled_from([3, 60]))
def test_no_distance_depends_on_what_was_asked_before(seed: int, count: int) -> None:
    problem = program_of(cluttered(seed, count), [Actuate("door", {"hinge": 1.2})], options=SHORT)
    z = random_configurations(
        problem.chain.lower, problem.chain.upper, 6, np.random.default_rng(seed)
    )
    waypoints = np.full(len(z), problem.ends[2])
    few = problem.contacts.evaluate(z, waypoints, reach=0.3, nearest=3)
    every = problem.contacts.evaluate(z[::-1], waypoints, reach=0.3)
    for row in range(len(z)):
        mine, same = few.waypoint == row, np.flatnonzero(every.waypoint == len(z) - 1 - row)[:3]
        for one, other in zip(few.arrays()[1:], every.arrays()[1:], strict=True):
            np.testing.assert_array_equal(one[mine], other[same])


# --- validation
# -----------------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.sampled_from([0, 3, 40, 150]), st.sampled_from([0.02, 0.1, 0.5]))
def test_validation_sees_what_brute_force_sees(seed: int, count: int, size: float) -> None:
    scene = cluttered(seed, count)
    check_sweep(scene, wander(scene, seed, size=size))


@settings(max_examples=12, deadline=None)
@given(SEEDS, st.sampled_from([0, 1, 60]), st.sampled_from([0.02, 0.1, 0.5]))
def test_validation_sees_what_brute_force_sees_of_what_is_carried(
    seed: int, count: int, size: float
) -> None:
    check_sweep(*whirl(seed, size=size, scene=cluttered_room(seed, count)))


def check_sweep(scene: Scene, motion: Trajectory) -> None:
    """The smallest distance of all, whatever overlaps at a sample, and whatever falls short of its margin at a waypoint."""
    samples = Samples(scene, motion)
    table = PairTable(scene, CollisionShapes(samples.world), motion, 0.02)
    hits = list(sweep(table, samples.z, samples.waypoint_rows))
    moves = table._moves[
        table._phase[np.searchsorted(samples.waypoint_rows, np.arange(len(samples.z)))]
    ]
    distances = np.where(moves[:, table.pairs].any(axis=2), brute_force(table, samples.z), np.inf)
    at_samples = min(hit.distance for hit in hits)
    assert at_samples <= distances.min() + COAL
    assert (
        at_samples >= distances.min() - 2e-3 or min(distances.min(), 0.0) > at_samples
    )  # it looks between samples, too
    found = {(hit.row, hit.first, hit.second) for hit in hits}
    for row, k in np.argwhere(distances < -COAL):
        assert (row, *pair_names(table, k)) in found
    for t, k in np.argwhere(distances[samples.waypoint_rows] < 0.02 - COAL):
        assert (samples.waypoint_rows[t], *pair_names(table, k)) in found
    for row in samples.waypoint_rows.tolist():  # and the closest pair of every waypoint
        closest = min(hit.distance for hit in hits if hit.at_waypoint and hit.row == row)
        assert closest == pytest.approx(distances[row].min(), abs=COAL)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.sampled_from([3, 40]), st.sampled_from([0.05, 0.5]))
def test_bounds_are_bounds(seed: int, count: int, size: float) -> None:
    scene = cluttered(seed, count)
    samples = Samples(scene, wander(scene, seed, size=size))
    table = PairTable(scene, CollisionShapes(samples.world), samples.trajectory, 0.02)
    z = samples.z[samples.waypoint_rows]
    distances = brute_force(table, z)
    moves = table._moves[table._phase][:, table.pairs].any(axis=2)
    placed, count = table.solids.place(samples.world.coordinates.q(z)), len(table.pairs)
    at, pairs = np.repeat(np.arange(len(z)), count), np.tile(table.pairs, (len(z), 1))
    bounds = placed.compute_lower_bounds(at, pairs).reshape(-1, count)
    assert (bounds <= distances + COAL).all()
    assert (bounds[np.isfinite(bounds)] >= 0.0).all()
    for reach in (0.02, 0.5):
        close = table.find_close_pairs(
            placed,
            np.arange(len(z)),
            np.arange(len(z)),
            np.zeros((len(z), len(table.groups))),
            reach,
        )
        assert set(map(tuple, np.argwhere((distances < reach - COAL) & moves).tolist())) <= set(
            zip(*map(np.ndarray.tolist, close), strict=True)
        )
    np.testing.assert_allclose(
        placed.compute_distances(at, pairs).reshape(-1, count), distances, rtol=0.0, atol=COAL
    )
    nearest, least = placed.find_nearest(table.pairs)
    np.testing.assert_allclose(least, distances.min(axis=1), rtol=0.0, atol=COAL)
    np.testing.assert_allclose(
        distances[np.arange(len(z)), nearest], distances.min(axis=1), rtol=0.0, atol=COAL
    )
    moved = np.diff(bound_displacements(table.solids, samples.z)[samples.waypoint_rows], axis=0)
    floor = (distances[:-1] + distances[1:] - moved[:, table.pairs].sum(axis=2)) / 2
    for smallest in (1e-3, 0.1):
        active = set(
            zip(
                *map(np.ndarray.tolist, _Sweep(table)._find_active_pairs(placed, moved, smallest)),
                strict=True,
            )
        )
        assert set(map(tuple, np.argwhere(floor < smallest - COAL).tolist())) <= active


# --- plans
# ----------------------------------------------------------------------------------------------------------


def cull_nothing(patch: pytest.MonkeyPatch) -> None:
    """Let every pair be asked of coal, at every configuration that anybody asks about."""

    def all_of_them(
        near: Clearances,
        q: np.ndarray,
        z: np.ndarray,
        at: np.ndarray,
        *,
        reach: float,
        max_pairs: Any = None,
        include_fixed: bool = True,
    ) -> ClosePairs:
        where, every = near.placements.compute_placements(q), near.boxes.pairs
        w, k = np.indices((len(q), len(every))).reshape(2, -1)
        margins = near.margins.compute_margins(k, at[w], z, w)
        counts = (margins > -np.inf) & (include_fixed | (every[k, 1] < where.shape[1]))
        w, k, margins = w[counts], k[counts], margins[counts]
        known: dict[str, Any] = {
            "ranks": k,
            "margins": margins,
            "bounds": np.full(len(k), -np.inf),
            "rounding": 0.0,
        }
        edges = np.searchsorted(w, np.arange(len(q) + 1))
        chosen, found = near.shapes.find_closest_pairs(
            where, edges, every[k], reach=reach, max_pairs=max_pairs, **known
        )
        return ClosePairs(w[chosen], k[chosen], found.distance, margins[chosen], *found[1:])

    def one_by_one(
        near: Clearances,
        q: np.ndarray,
        z: np.ndarray,
        waypoint: int,
        *,
        reach: float,
        allowed: float,
    ) -> int:
        found = all_of_them(near, q, z, np.full(len(q), waypoint), reach=reach)
        return int(min(found.row[found.margin - found.distance > allowed], default=len(q)))

    def nowhere(placed: PlacedShapes, states: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        return np.full(len(pairs), -np.inf)

    def all_of(
        table: PairTable,
        _: PlacedShapes,
        first: np.ndarray,
        last: np.ndarray,
        moved: np.ndarray,
        limit: float,
    ) -> tuple[np.ndarray, ...]:
        return np.nonzero(table._moves[table._phase[last]][:, table.pairs].any(axis=2))

    def everywhere(
        shape: coal.CollisionGeometry, placement: pin.SE3
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.full(3, -1e3), np.full(3, 1e3)

    patch.setattr(Clearances, "find_closest_pairs", all_of_them)
    patch.setattr(Clearances, "find_first_violation", one_by_one)
    patch.setattr(PlacedShapes, "compute_lower_bounds", nowhere)
    patch.setattr(PairTable, "find_close_pairs", all_of)
    patch.setattr(
        MovingShapes, "_find_close_pairs", lambda body, along: np.arange(len(body.moving))
    )
    for module in (geometry, easing):
        patch.setattr(module, "compute_world_box", everywhere)


@pytest.mark.parametrize("task", ["door", pytest.param("stick", marks=pytest.mark.long)])
def test_culling_changes_no_plan(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same motion and the same verdict, but for last digits that hang on what was planned before in this process."""
    steps: list[Step] = [Actuate("door", {"hinge": 1.2})]
    scene = crowded(30)
    if task == "stick":  # it is put down further along the table, beside a fence
        steps = [Place("stick", lifted(STICK, [0.0, 0.4, 0.0]))]
        scene = room(
            table(), *(box(f"pale_{k}", [0.1] * 3, [1.5, 0.12 * k - 1.0, 0.5]) for k in range(20))
        )
    counts, found = [], []
    for culled in (True, False):
        counter = Counter()
        with monkeypatch.context() as patch:
            if not culled:
                cull_nothing(patch)
            with counter.counting(patch):
                found.append(plan(scene, steps))
        counts.append(counter.asked)
    one, other = found
    assert 10 * counts[0] < counts[1]
    assert one.success
    assert other.success
    assert one.initialization == other.initialization
    np.testing.assert_allclose(
        one.trajectory.positions, other.trajectory.positions, rtol=0.0, atol=1e-5
    )
    for name in ("clearance", "closure_error", "base_path_length", "arm_path_length"):
        assert one.metrics[name] == pytest.approx(other.metrics[name], abs=1e-5)
    for name in ("rounds", "iterations"):
        assert one.metrics[name] == other.metrics[name]


# --- scenes
# ---------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([1, 5, 60]), st.sampled_from([np.inf, 0.3, 0.03]))
def test_the_clearance_at_the_start_is_that_of_all_pairs(
    seed: int, count: int, reach: float
) -> None:
    scene = cluttered(seed, count)
    model, geometry = scene.robot.model, scene.robot.collision
    data, shapes = model.createData(), geometry.createData()
    pin.updateGeometryPlacements(
        model, data, geometry, shapes, scene.robot.coordinates.q(scene.start)
    )
    moving = [
        (shape.geometry, where)
        for shape, where in zip(geometry.geometryObjects, shapes.oMg, strict=True)
    ]
    standing = [
        s for s, label in zip(scene.obstacles, scene.obstacle_labels, strict=True) if label != FLOOR
    ]
    standing += make_world_shapes(scene.objects["door"])
    expected = min(
        compute_shape_distance(shape, where, other.geometry, other.placement)
        for shape, where in moving
        for other in standing
    )
    found = scene.start_clearance(reach=reach)
    assert found == (pytest.approx(expected, abs=1e-9) if expected < reach else reach)
    assert compute_clearance(moving, []) == np.inf


def test_what_a_scene_does_not_change_it_shares() -> None:
    scene = crowded(100)
    moved = (
        scene.with_start(base=[-0.5, 0.2, 0.0])
        .with_state("door", {"hinge": 0.5})
        .with_held({"door": "handle"})
    )
    assert moved.obstacles is scene.obstacles
    assert moved.described is scene.described
    assert moved.document["obstacles"] == scene.document["obstacles"]
    assert scene.document["start"]["base"] == scene.start[:3].tolist()
    assert scene.document["start"]["held"] == {}
    assert scene.document["objects"][0]["state"]["hinge"] == 0.0


def test_a_world_shows_all_its_shapes() -> None:
    world = World(crowded(50))
    assert [shape.name for shape in world.shapes] == [
        shape.name for shape in world.collision.geometryObjects
    ]
    assert len(world.shapes) == len(world.collision_labels)
    for shape, twin in zip(world.shapes, world.collision.geometryObjects, strict=True):
        assert shape.parentJoint == twin.parentJoint
        np.testing.assert_allclose(
            shape.placement.homogeneous, twin.placement.homogeneous, atol=1e-12
        )
