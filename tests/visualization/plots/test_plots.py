from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vkc_pin import InputError, Plan
from vkc_pin.visualization.plots import plots as plotting
from vkc_pin.world.trajectory.curve import Curve


@pytest.fixture(scope="module")
def figures(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("plots") / "new"
    figures = plotting.plot(plan, folder)
    assert isinstance(figures, dict)
    assert sorted(file.name for file in folder.iterdir()) == [
        "clearance.png",
        "joints.png",
        "top_view.png",
    ]
    return {"folder": folder, **figures}


def map_lines(axes: Any) -> dict[str, Any]:
    return {line.get_label(): line for line in axes.get_lines()}


def test_joint_plot_shows_positions_rates_and_limits(figures: dict[str, Any], plan: Plan) -> None:
    axes, motion = figures["joints"].axes, plan.trajectory
    labels = [a.get_ylabel().partition(" [") for a in axes]
    assert [name for name, _, _ in labels] == [
        f"{group} {quantity}"
        for group in ("base", "arm", "object")
        for quantity in ("position", "velocity", "acceleration")
    ]
    assert all(unit for _, _, unit in labels)
    assert [text.get_text() for text in axes[0].texts] == ["reach door.handle", "move door.hinge"]
    (band,) = axes[0].patches  # the second phase is shaded
    assert (band.get_x(), band.get_width()) == pytest.approx((3.0, 3.0))
    for panel, name in ((axes[0], "base_yaw"), (axes[6], "door.hinge")):
        line = map_lines(panel)[name]
        assert set(motion.times) <= set(line.get_xdata())
        assert np.allclose(line.get_ydata(), motion(line.get_xdata())[:, motion.names.index(name)])
    for panel, limit in ((axes[4], np.pi), (axes[5], 1.4)):  # limits of the arm's joints
        assert any(np.allclose(line.get_ydata(), limit, atol=0.01) for line in panel.get_lines())
    velocity, acceleration = (a.get_lines()[0] for a in axes[1:3])
    assert np.allclose(velocity.get_ydata(), motion.velocity(velocity.get_xdata())[:, 0])
    # Without a curve, accelerations are those at the waypoints, as in eq. 5.
    assert np.allclose(acceleration.get_xdata(), motion.times)
    assert np.allclose(acceleration.get_ydata(), motion.accelerations()[:, 0])


def test_rates_are_evaluated_on_the_curve(plan: Plan) -> None:
    """Both values of a jump at a knot are drawn, and peaks between samples are preserved."""
    motion = plan.trajectory
    rates = np.gradient(motion.positions, motion.times, axis=0)
    curve = Curve(motion.times, motion.positions, rates)
    smooth = dataclasses.replace(plan, trajectory=dataclasses.replace(motion, curve=curve))
    for panel, evaluate, peaks in zip(
        plotting.plot_joints(smooth).axes[1:3],
        (curve.velocity, curve.acceleration),
        curve.compute_max_rates(),
        strict=True,
    ):
        line = panel.get_lines()[2]
        assert np.allclose(line.get_ydata(), evaluate(line.get_xdata())[:, 2])
        assert np.abs(line.get_ydata()).max() == pytest.approx(peaks[:, 2].max(), rel=1e-3)


def test_pairs_that_may_touch_are_dotted(figures: dict[str, Any]) -> None:
    (axes,) = figures["clearance"].axes
    styles = {line.get_label().split(":")[0]: line.get_linestyle() for line in axes.lines}
    assert styles["gripper – grasped object"] == ":"
    assert styles["robot – itself"] == "-"


def test_clearance_names_the_closest_pairs(figures: dict[str, Any], plan: Plan) -> None:
    (axes,) = figures["clearance"].axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [s]", "clearance [mm]")
    (legend,) = figures["clearance"].legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert any(text.startswith("robot – obstacles") and " mm, " in text for text in texts)
    assert any("required: 20 mm" in text for text in texts)


def test_top_view_shows_rooms_base_and_paths(figures: dict[str, Any], plan: Plan) -> None:
    (axes,), positions = figures["top_view"].axes, plan.trajectory.positions
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    assert axes.get_aspect() == 1.0
    path = np.column_stack(map_lines(axes)["path of the base"].get_data())
    assert np.allclose(path[[0, -1]], positions[[0, -1], :2], atol=1e-6)
    outlines = {patch.get_label(): patch.get_xy() for patch in axes.patches}
    for name, row in (("start", 0), ("end", -1)):
        low, high = outlines[name].min(axis=0), outlines[name].max(axis=0)
        assert np.allclose((low + high) / 2, positions[row, :2], atol=0.1)
        assert 0.9 < (high - low).max() < 1.3, "the Husky is 0.99 m long and 0.67 m wide"
    corners = [patch.get_xy() for patch in axes.patches]
    boxes = [np.concatenate([one.min(axis=0), one.max(axis=0)]) for one in corners]
    assert any(np.allclose(box, [-2.4, -1.775, -0.6, -1.125], atol=1e-3) for box in boxes), "sofa"
    assert any(not patch.get_fill() for patch in axes.patches), "the lintel is above the robot"


def test_combined_figure_is_written_only_to_a_named_file(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "deep" / "all.svg"
    for path in (None, file):
        figure = plotting.plot(plan, path)
        assert not isinstance(figure, dict)
        assert len(figure.axes) == 11
    assert list(tmp_path.rglob("*.*")) == [file]
    assert file.read_bytes().startswith(b"<?xml")


def test_invalid_arguments_are_rejected(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Plan"):
        plotting.plot(plan.scene)  # type: ignore[arg-type]
    (tmp_path / "taken").write_text("")
    with pytest.raises(InputError, match="file"):
        plotting.plot(plan, tmp_path / "taken")
