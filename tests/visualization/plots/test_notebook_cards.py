from __future__ import annotations

import base64
import dataclasses
import io
import re

import numpy as np

import vkc_pin as vkc
from vkc_pin import Plan, Report


def decode_picture(html: str) -> np.ndarray:
    """Return the pixels of the only picture in the card."""
    from PIL import Image

    (data,) = re.findall(r'src="data:image/png;base64,([A-Za-z0-9+/=]+)"', html)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), int)


def parse_cells(html: str) -> dict[str, str]:
    return dict(re.findall(r"<tr><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)</td></tr>", html))


def test_card_of_a_failed_plan_lists_the_first_violations(plan: Plan) -> None:
    html = plan._repr_html_()
    assert re.search(r'door: <span style="color: #c62828">FAILED, rejected</span>', html)
    assert "<li>penetration forearm_link – sofa: overlap by 30 mm (waypoint 9, 4.00 s)</li>" in html
    assert parse_cells(html)["base"] == f"{plan.metrics['base_path_length']:.2f} m"
    (violation,) = plan.report.violations
    report = Report((violation,) * 9, notes=("no path",))
    html = dataclasses.replace(plan, report=report)._repr_html_()
    assert html.count("<li>") == 7
    assert "... and 4 more" in html


def test_card_of_a_valid_plan_shows_its_metrics_and_path(door_plan: Plan) -> None:
    html, metrics = door_plan._repr_html_(), door_plan.metrics
    assert '<span style="color: #1a7f37">success</span>' in html
    assert "<li>" not in html
    expected = {
        "base": f"{metrics['base_path_length']:.2f} m",
        "arm": f"{metrics['arm_path_length']:.2f} rad",
        "clearance": f"{1e3 * metrics['clearance']:.1f} mm",
        "duration": f"{metrics['duration']:.1f} s",
        "planned in": f"{metrics['planning_time']:.2f} s",
        "seed": f"{door_plan.initialization}, random numbers 0",
    }
    cells = parse_cells(html)
    assert {name: cells[name] for name in expected} == expected
    assert "reach door.handle" in html
    assert len(html) < 60_000
    tool_path = (224, 51, 89)  # colour of the tool path
    planned, empty = (
        (np.abs(decode_picture(card) - tool_path).max(axis=2) < 40).sum()
        for card in (html, door_plan.scene._repr_html_())
    )
    assert planned > 20
    assert empty == 0


def test_markup_in_names_is_escaped(plan: Plan) -> None:
    markup = '<script>alert(1)</script>&"'
    scene = dataclasses.replace(plan.scene, name=markup)
    violation = dataclasses.replace(plan.report.violations[0], subject=markup, detail=markup)
    phases = tuple(dataclasses.replace(phase, name=markup) for phase in plan.trajectory.phases)
    modified = dataclasses.replace(
        plan,
        scene=scene,
        status=markup,
        initialization=markup,
        trajectory=dataclasses.replace(plan.trajectory, phases=phases),
        report=Report((violation,), notes=(markup,)),
    )
    for html in (modified._repr_html_(), scene._repr_html_()):
        assert "<script" not in html
        assert "&lt;script&gt;alert(1)&lt;/script&gt;&amp;&quot;" in html


def test_card_of_a_scene_lists_its_objects() -> None:
    html = vkc.load_scene("init_3")._repr_html_()
    values = parse_cells(html)
    assert "stick (can be carried)" in values["objects"]
    assert re.fullmatch(r"[\d.]+ m × [\d.]+ m", values["arena"])
    assert values["obstacles"] == str(len(vkc.load_scene("init_3").obstacle_names))
    assert "door (hinge, knob)" in parse_cells(vkc.load_scene("door")._repr_html_())["objects"]
    assert len(html) < 60_000
    assert len(np.unique(decode_picture(html).reshape(-1, 3), axis=0)) > 10
