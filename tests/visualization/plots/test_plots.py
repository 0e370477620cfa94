from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import fake_plan

from vkc_pin.errors import InputError
from vkc_pin.planning.plan import Plan
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import CheckedMotion
from vkc_pin.visualization.plots import joints
from vkc_pin.visualization.plots import plots as plotting
from vkc_pin.visualization.plots.joints import Quantity
from vkc_pin.world.trajectory.curve import Curve


@pytest.fixture(scope="module")
def plan() -> Plan:
    return fake_plan()


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


def colours(file: Path) -> int:
    from PIL import Image

    return len(np.unique(np.asarray(Image.open(file).convert("RGB")).reshape(-1, 3), axis=0))


def lines(axes: Any) -> dict[str, Any]:
    return {line.get_label(): line for line in axes.get_lines()}


@pytest.mark.parametrize("name", ["joints", "clearance", "top_view"])
def test_pictures_are_not_empty(figures: dict[str, Any], name: str) -> None:
    assert colours(figures["folder"] / f"{name}.png") > 100


def test_positions_and_rates_by_group_with_limits(figures: dict[str, Any], plan: Plan) -> None:
    axes = figures["joints"].axes
    assert [a.get_ylabel().split(" [")[0] for a in axes] == [
        f"{group} {what}"
        for group in ("base", "arm", "object")
        for what in ("position", "velocity", "acceleration")
    ]
    assert all("[" in a.get_ylabel() for a in axes)
    assert [a.get_xlabel() for a in axes[-3:]] == ["time [s]"] * 3
    motion = plan.trajectory
    for shown, name in ((axes[0], "base_yaw"), (axes[6], "door.hinge")):
        line = lines(shown)[name]
        assert set(motion.times) <= set(line.get_xdata())
        assert np.allclose(line.get_ydata(), motion(line.get_xdata())[:, motion.names.index(name)])
    for shown, limit in ((axes[4], np.pi), (axes[5], 1.4)):  # of all the arm's joints
        assert any(np.allclose(line.get_ydata(), limit, atol=0.01) for line in shown.get_lines())
    speed, strength = (a.get_lines()[0] for a in axes[1:3])
    assert np.allclose(speed.get_ydata(), motion.velocity(speed.get_xdata())[:, 0])
    assert np.allclose(strength.get_xdata(), motion.times)  # without a curve, as eq. 5 has it
    assert np.allclose(strength.get_ydata(), motion.accelerations()[:, 0])
    assert all(a.get_legend() is not None for a in axes[2::3])


def test_rates_are_the_curve_s(plan: Plan) -> None:
    """Accelerations jump at knots: both values are drawn, and no peak is lost between samples."""
    motion = plan.trajectory
    curve = Curve(
        motion.times, motion.positions, np.gradient(motion.positions, motion.times, axis=0)
    )
    smooth = dataclasses.replace(plan, trajectory=dataclasses.replace(motion, curve=curve))
    for number, (shown, peaks) in enumerate(
        zip(plotting.plot_joints(smooth).axes[1:3], curve.compute_max_rates(), strict=True), 1
    ):
        line = shown.get_lines()[2]
        read = (curve.velocity, curve.acceleration)[number - 1]
        assert np.allclose(line.get_ydata(), read(line.get_xdata())[:, 2])
        assert np.abs(line.get_ydata()).max() == pytest.approx(peaks[:, 2].max(), rel=1e-3)


def test_a_quantity_that_only_some_have_leaves_the_others_free(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torques, say: a column more, without axes where there is none."""

    def torques(plan: CheckedMotion, times: Floats) -> tuple[Floats, Floats]:
        values = np.full((len(times), len(plan.trajectory.names)), np.nan)
        values[:, 3:9] = 20.0
        return times, values

    made = Quantity(
        "torque", {"m": "N", "rad": "N·m"}, torques, lambda plan, name: 150.0, lambda motion: {}
    )
    monkeypatch.setattr(joints, "QUANTITIES", (*joints.QUANTITIES, made))
    axes = plotting.plot_joints(plan).axes
    assert [a.get_ylabel() for a in axes[3::4] if a.get_visible()] == ["arm torque [N·m]"]
    assert len(axes) == 12


def test_phases_are_named_and_shaded(figures: dict[str, Any], plan: Plan) -> None:
    top = figures["joints"].axes[0]
    assert [text.get_text() for text in top.texts] == ["reach door.handle", "move door.hinge"]
    (band,) = top.patches
    assert band.get_x() == pytest.approx(3.0)
    assert band.get_x() + band.get_width() == pytest.approx(6.0)


def test_clearance_names_the_closest_pairs(figures: dict[str, Any], plan: Plan) -> None:
    (axes,) = figures["clearance"].axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [s]", "clearance [mm]")
    (legend,) = figures["clearance"].legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert any(text.startswith("robot – obstacles") and " mm, " in text for text in texts)
    assert any("required: 20 mm" in text for text in texts)


def test_top_view_shows_rooms_base_and_paths(figures: dict[str, Any], plan: Plan) -> None:
    (axes,) = figures["top_view"].axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    assert axes.get_aspect() == 1.0
    drawn = lines(axes)
    base = np.column_stack(drawn["path of the base"].get_data())
    assert np.allclose(base[[0, -1]], plan.trajectory.positions[[0, -1], :2], atol=1e-6)
    outlines = {patch.get_label(): patch.get_xy() for patch in axes.patches}
    for name, row in (("start", 0), ("end", -1)):
        corners = outlines[name]
        assert np.allclose(
            (corners.min(axis=0) + corners.max(axis=0)) / 2,
            plan.trajectory.positions[row, :2],
            atol=0.1,
        )
        assert 0.9 < np.ptp(corners, axis=0).max() < 1.3, "the Husky is 0.99 m long and 0.67 m wide"
    boxes = [(patch.get_xy().min(axis=0), patch.get_xy().max(axis=0)) for patch in axes.patches]
    sofa = ([-2.4, -1.775], [-0.6, -1.125])
    assert any(
        np.allclose(low, sofa[0], atol=1e-3) and np.allclose(high, sofa[1], atol=1e-3)
        for low, high in boxes
    )
    assert any(not patch.get_fill() for patch in axes.patches), "the lintel is above the robot"


@pytest.mark.parametrize(
    ("suffix", "head"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")]
)
def test_one_combined_figure(plan: Plan, tmp_path: Path, suffix: str, head: bytes) -> None:
    file = tmp_path / "deep" / f"all{suffix}"
    figure = plotting.plot(plan, file)
    assert not isinstance(figure, dict)
    assert len(figure.axes) == 11
    assert file.read_bytes().startswith(head)
    assert [f.name for f in file.parent.iterdir()] == [file.name], "no temporary file stays"


def test_without_a_path_nothing_is_written(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(plotting.plot(plan).axes) == 11  # type: ignore[union-attr]
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_plotted(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Plan"):
        plotting.plot(plan.scene)  # type: ignore[arg-type]
    (tmp_path / "taken").write_text("")
    with pytest.raises(InputError, match="file"):
        plotting.plot(plan, tmp_path / "taken")


def test_importing_it_loads_neither_matplotlib_nor_meshcat() -> None:
    heavy = ("matplotlib", "meshcat", "trimesh")
    modules = "vkc_pin.visualization.plots.plots, vkc_pin.visualization.viewer"
    code = f"import sys, {modules}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_settings_of_others_stay_as_they_are(plan: Plan) -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    plotting.plot_joints(plan)
    assert dict(matplotlib.rcParams) == before
