from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from helpers.telescopes import format_joint

from vkc_pin import Robot, load_robot
from vkc_pin.utils import disk_cache
from vkc_pin.world.files import resources
from vkc_pin.world.files.srdf import read_srdf
from vkc_pin.world.models.self_collisions import (
    sample_allowed_pairs,
    write_srdf,
)

SRDF = resources.find_resource_folder("robots") / "husky_ur5e" / "husky_ur5e.srdf"


def test_committed_srdf_matches_sampling(husky: Robot) -> None:
    committed = read_srdf(SRDF, husky.file.root)
    assert sample_allowed_pairs(husky, samples=3000, seed=7) == committed.allowed


def test_sampled_pairs_are_adjacent_or_always_or_never_collide(tmp_path: Path) -> None:
    radii = {"foot": 1.0, "middle": 0.1, "inner": 0.2, "outer": 0.1}
    file = write_arm(
        tmp_path,
        *(format_ball(name, radius) for name, radius in radii.items()),
        format_hinge("foot", "middle", 0.3, upper=1.0),
        format_hinge("middle", "inner", 0.2, upper=1.0),
        format_hinge("inner", "outer", 4.0, upper=1.0),
    )
    assert sample_allowed_pairs(load_robot(file, pairs="all"), samples=50) == {
        ("foot", "inner"): "Always",
        ("foot", "middle"): "Adjacent",
        ("foot", "outer"): "Never",
        ("inner", "middle"): "Adjacent",
        ("inner", "outer"): "Adjacent",
        ("middle", "outer"): "Never",
    }


def test_written_srdf_can_be_read(husky: Robot, tmp_path: Path) -> None:
    file = write_srdf(husky, tmp_path / "new.srdf", samples=50)
    again = read_srdf(file, husky.file.root)
    assert again.allowed == sample_allowed_pairs(husky, samples=50)
    home = again.find_home(husky.coordinates.names[3:])
    assert list(home.values()) == pytest.approx(list(husky.home))
    assert load_robot("husky_ur5e", srdf=file).home == pytest.approx(husky.home)


def format_ball(name: str, radius: float, x: float = 0.0) -> str:
    shape = f'<origin xyz="{x} 0 0"/><geometry><sphere radius="{radius}"/></geometry>'
    return f'<link name="{name}"><collision>{shape}</collision></link>'


def format_hinge(
    parent: str,
    child: str,
    x: float = 0.0,
    *,
    kind: str = "revolute",
    axis: str = "0 0 1",
    upper: float = 1.5,
) -> str:
    return format_joint(f"{child}_joint", kind, parent, child, f"{x} 0 0", axis, (-upper, upper))


def list_checked(robot: Robot) -> set[tuple[str, ...]]:
    """Return the sorted pairs of links that are checked for collisions."""
    pairs = robot.collision.collisionPairs
    return {tuple(sorted((robot.link_of(p.first), robot.link_of(p.second)))) for p in pairs}


def write_arm(folder: Path, *parts: str, srdf: str | None = None) -> Path:
    file = folder / "arm.urdf"
    file.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    if srdf is not None:
        (folder / "arm.srdf").write_text(f'<robot name="arm">{srdf}</robot>')
    return file


def write_bracket(folder: Path, *, elbow_x: float, srdf: str | None = None) -> Path:
    """Write a post with a fixed bracket, and a shoulder with a fixed cover and a remote elbow."""
    return write_arm(
        folder,
        format_ball("post", 0.05),
        format_ball("bracket", 0.02, 0.09),
        format_ball("shoulder", 0.03),
        format_ball("cover", 0.03, 0.05),
        format_ball("elbow", 0.02),
        format_hinge("post", "bracket", kind="fixed"),
        format_hinge("post", "shoulder"),
        format_hinge("shoulder", "cover", kind="fixed"),
        format_hinge("shoulder", "elbow", elbow_x),
        srdf=srdf,
    )


def test_close_neighbours_missing_in_the_srdf_are_adjacent(tmp_path: Path) -> None:
    robot = load_robot(write_bracket(tmp_path, elbow_x=0.5, srdf=""))
    checked = list_checked(robot)
    assert not checked & {
        ("post", "shoulder"),
        ("bracket", "cover"),
        ("cover", "post"),
        ("bracket", "shoulder"),
    }
    assert ("elbow", "post") in checked


def write_slider(folder: Path, *, gap: float, srdf: str | None = None, at: float = 0.0) -> Path:
    """Write a finger of radius 20 mm on two slides, at most `gap` away from the wall ahead."""
    return write_arm(
        folder,
        format_ball("wall", 0.02),
        format_ball("carriage", 0.001, 2.0),
        format_ball("finger", 0.02),
        format_hinge("wall", "carriage", 0.04 + at, kind="prismatic", axis="1 0 0", upper=gap),
        format_hinge("carriage", "finger", kind="prismatic", axis="0 1 0", upper=1e-6),
        srdf=srdf,
    )


def test_tight_pairs_have_half_their_distance_as_margin(tmp_path: Path) -> None:
    robot = load_robot(write_slider(tmp_path, gap=0.012, at=0.004))
    assert list(robot.tight) == [("finger", "wall")]
    # At home; the maximum would be 16 mm.
    assert robot.tight["finger", "wall"] == pytest.approx(0.004, abs=1e-9)
    assert robot.own_margin(("finger", "wall"), 0.02) == pytest.approx(0.002, abs=1e-9)
    assert robot.own_margin(("finger", "wall"), 0.001) == 0.001
    assert robot.own_margin(("carriage", "wall"), 0.02) == 0.02
    ((pair, margin),) = robot.own_margins(0.02).items()
    assert {robot.link_of(k) for k in pair} == {"finger", "wall"}
    assert margin == pytest.approx(0.002, abs=1e-9)


@pytest.mark.parametrize("srdf", [None, ""], ids=["sampled", "srdf"])
def test_links_that_always_touch_are_not_checked(tmp_path: Path, srdf: str | None) -> None:
    file = write_slider(tmp_path, gap=0.0005, srdf=srdf)
    other = (
        format_ball("far", 0.01)
        + format_hinge("finger", "far", 0.5, upper=3.1)
        + format_ball("end", 0.3)
        + format_hinge("far", "end", 0.4)
    )
    file.write_text(file.read_text().replace("</robot>", f"{other}</robot>"))
    message = r"arm.urdf: links that always overlap or touch are not checked: finger – wall$"
    warning = nullcontext() if srdf is None else pytest.warns(UserWarning, match=message)
    with warning:
        checked = list_checked(load_robot(file))
    assert ("finger", "wall") not in checked
    assert ("end", "wall") in checked


def test_overlap_at_a_stated_home_warns(tmp_path: Path) -> None:
    file = write_slider(tmp_path, gap=0.1, at=0.02, srdf="")
    home = {"carriage_joint": -0.03, "finger_joint": 0.0}
    with pytest.warns(
        UserWarning, match=r"links that overlap at home are not checked: finger – wall$"
    ):
        robot = load_robot(file, home=home, srdf=file.with_suffix(".srdf"), pairs="sampled")
    assert robot.home.tolist() == [-0.03, 0.0]


def test_unstated_homes_are_collision_free(tmp_path: Path) -> None:
    """Only joints without stated position are moved, as little as possible, reproducibly."""
    file = write_slider(tmp_path, gap=0.1, at=-0.01)
    with pytest.warns(
        UserWarning,
        match=r"arm.urdf: links overlap at the default home; .* carriage_joint: 0.0\d+",
    ):
        robot = load_robot(file)
    assert 0.03 - 1e-9 <= robot.home[0] < 0.06  # 20 mm of clearance
    with pytest.warns(UserWarning, match="links overlap"):
        np.testing.assert_array_equal(load_robot(file).home, robot.home)


def test_analysis_is_cached_by_its_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second call reads the cached file; changed shapes, limits or homes write a new one."""
    cache = tmp_path / "cache"
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, str(cache))
    file = write_slider(tmp_path, gap=0.012, at=0.004)
    first, again = load_robot(file), load_robot(file)
    assert len(list(cache.rglob("*.json"))) == 1
    assert (first.tight, first.home.tolist(), first.own_margins(0.02)) == (
        again.tight,
        again.home.tolist(),
        again.own_margins(0.02),
    )
    text = file.read_text()
    for count, change in enumerate(
        [("0.02", "0.021"), ('upper="0.012"', 'upper="0.013"'), ("0.044", "0.045")], 2
    ):
        file.write_text(text.replace(*change))
        load_robot(file)
        assert len(list(cache.rglob("*.json"))) == count
    file.write_text(text)
    load_robot(file, home={"carriage_joint": 0.001})
    assert len(list(cache.rglob("*.json"))) == 5
