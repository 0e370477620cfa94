from __future__ import annotations

import dataclasses

import pytest

import vkc_pin as vkc
from vkc_pin.importing.proposals.hand import make_hand


def test_hand_dimensions_agree_with_the_data_sheet() -> None:
    hand = make_hand(vkc.load_robot("husky_ur5e"))
    assert hand.opening == pytest.approx(0.086, abs=2e-4)  # robots/husky_ur5e/README.md
    assert 0.015 < hand.tip < 0.022
    assert 0.018 < hand.width < 0.04
    assert len(hand.touch) == 5
    assert len(hand.others) == 1  # the wrist


def test_robot_without_touch_links_has_no_hand() -> None:
    robot = dataclasses.replace(vkc.load_robot("husky_ur5e"), touch_links=())
    with pytest.raises(vkc.InputError, match="touch_links"):
        make_hand(robot)


def test_tool_frame_inside_the_palm_is_rejected() -> None:
    robot = dataclasses.replace(vkc.load_robot("husky_ur5e"), tool_frame="gripper_link")
    with pytest.raises(vkc.InputError, match="no room between the fingers"):
        make_hand(robot)
