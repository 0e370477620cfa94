from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.furniture import BAR, write_flap

import vkc_pin as vkc
from vkc_pin.importing.proposals.hand import make_hand


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> vkc.importing.Proposals:
    return vkc.importing.propose_attachments(
        write_flap(tmp_path_factory.mktemp("flap"), BAR.format(' name="handle"'))
    )


def test_descriptions_load_as_the_same_attachments(
    found: vkc.importing.Proposals, tmp_path: Path
) -> None:
    written = yaml.safe_dump([each.description() for each in found.found], default_flow_style=True)
    loaded = write_flap(tmp_path, BAR.format(""), attachments=written.strip())
    assert list(loaded.attachments) == [proposal.attachment.name for proposal in found.found]
    for proposal in found.found:
        expected, actual = proposal.attachment, loaded.attachment(proposal.attachment.name)
        assert np.allclose(expected.placement.homogeneous, actual.placement.homogeneous, atol=1e-5)
        assert (expected.joint, expected.coordinates) == (actual.joint, actual.coordinates)
        assert expected.standoff == pytest.approx(actual.standoff, abs=1e-5)
        for one, other in zip(expected.freedoms, actual.freedoms, strict=True):
            assert (one.lower, one.upper) == (other.lower, other.upper)
            assert np.allclose(one.axis, other.axis)


def test_report_lists_attachments_and_openings(found: vkc.importing.Proposals) -> None:
    lines = found.summary().splitlines()
    assert found.make_object().attachment().name == found.found[0].attachment.name == "flap_bar"
    assert found.opening("hinge") == found.found
    assert "flap_bar" in repr(found)
    assert lines[0] == "hinge, 0 to 1.5 rad"
    assert "flap_bar (bar, named as a handle): 20 mm thick, cylindrical" in lines[1]
    assert "opens to 1.5 rad" in lines[1]
    many = dataclasses.replace(found.found[0], when={f"j{k}": 1.0 for k in range(5)})
    line = dataclasses.replace(found, found=(many,)).summary().splitlines()[1]
    assert line.endswith("j2 is at 1 and 2 more joints are open")


def test_hand_dimensions_agree_with_the_data_sheet() -> None:
    hand = make_hand(vkc.load_robot("husky_ur5e"))
    assert hand.opening == pytest.approx(0.086, abs=2e-4)  # robots/husky_ur5e/README.md
    assert 0.015 < hand.tip < 0.022
    assert 0.018 < hand.width < 0.04
    assert len(hand.touch) == 5
    assert len(hand.others) == 1  # the wrist


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"touch_links": ()}, "touch_links"),
        ({"tool_frame": "gripper_link"}, "no room between the fingers"),  # inside the palm
    ],
)
def test_robot_without_fingers_has_no_hand(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(vkc.InputError, match=message):
        make_hand(dataclasses.replace(vkc.load_robot("husky_ur5e"), **changes))
