from __future__ import annotations

import numpy as np
from drives import hall

import vkc_pin as vkc
from vkc_pin.initialization import initialize
from vkc_pin.routes import Routes


def walled(gap: float) -> vkc.TrajectoryProblem:
    """Return the problem of driving past a wall across the hall that leaves a gap beside it [m]."""
    wall = {"name": "wall", "type": "box", "size": [0.2, 6.0 - gap, 1.5], "position": [2.0, gap / 2, 0.75]}
    scene = hall(obstacles=[wall])
    document = {**scene.document, "arena": {"x": [-3.0, 6.0], "y": [-3.0, 3.0]}}
    return vkc.build(vkc.Scene.from_document(document, scene.folder), [vkc.GoTo(4.0, 1.5, 0.0)])


def test_the_way_leads_through_the_gap() -> None:
    problem = walled(1.6)
    routes, start = Routes(problem), problem.start[:3]
    goal = np.array([4.0, 1.5, 0.0])
    way = routes.way(0, start, goal, 40)
    assert way is not None
    assert way.shape == (40, 3)
    np.testing.assert_allclose(way[-1, :2], goal[:2], atol=1e-9)
    assert abs((way[-1, 2] - goal[2] + np.pi) % (2 * np.pi) - np.pi) < 1e-9
    crossing = way[np.argmin(np.abs(way[:, 0] - 2.0))]
    assert crossing[1] < -1.4  # the wall reaches from y = -1.4 up
    assert routes.distances(0, start[None], goal[None])[0] > np.hypot(*(goal[:2] - start[:2])) + 1.0


def test_no_way_is_said() -> None:
    problem = walled(0.0)
    assert Routes(problem).way(0, problem.start[:3], np.array([4.0, 1.5, 0.0]), 40) is None
    notes: list[str] = []
    assert list(initialize(problem, "astar", 0, notes=notes)) == []
    assert len(notes) == 1
    assert "found no way for the base" in notes[0]
    plan = vkc.plan(problem.scene, [vkc.GoTo(4.0, 1.5, 0.0)], initialization="astar")
    assert plan.status == "infeasible"
    assert "found no way for the base" in plan.report()


def test_the_seed_drives_the_way_and_the_heading_follows_it() -> None:
    problem = walled(1.6)
    (seed,) = initialize(problem, "astar", 0)
    assert seed.name == "astar"
    path = problem.waypoints(seed.z)[:, :3]
    steps = np.diff(path[:, :2], axis=0)
    length = np.linalg.norm(steps, axis=1)
    heading = path[:-1, 2] + np.diff(path[:, 2]) / 2
    along = np.abs(steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading))
    assert np.sum(along) > 0.8 * np.sum(length)  # forwards or backwards, not sideways
    assert problem.evaluate_contacts(seed.z, reach=0.02).violation() < 0.02
