"""Tests the division of names into words."""

from __future__ import annotations

import pytest

from vkc_pin.utils.words import split_words


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("openarm_finger_joint1", "openarm finger joint 1"),
        ("forearm_roll", "fore arm roll"),
        ("LWristYaw", "l wrist yaw"),
        ("LLEG_HIP_R", "l leg hip r"),
        ("FL_thighJoint2", "fl thigh joint 2"),
        ("leftforearm-pitch", "left fore arm pitch"),
        ("rwheel", "r wheel"),
        ("omniwheel_1", "omni wheel 1"),
        ("fingertips", "finger tip"),
        ("joint_arm_l3", "joint arm l3"),
        ("arm2_6", "arm 2 6"),
        ("RIGHT_WHEEL", "right wheel"),
    ],
)
def test_compounds_and_capitals_are_divided(name: str, words: str) -> None:
    assert split_words(name) == words.split()


@pytest.mark.parametrize(
    "name", ["linear", "bearing", "rear", "gear", "charm", "alarm", "handle", "armature", "hipster"]
)
def test_parts_of_other_words_are_no_words(name: str) -> None:
    assert split_words(name) == [name]
