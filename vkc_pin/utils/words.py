"""Cleans names of links and joints, and divides them into words."""

from __future__ import annotations

import re


def clean_name(text: str) -> str:
    """Return a name that scenes accept: unprintable characters, ".", "/" and spaces become "_"."""
    plain = re.sub(r"[\s./]+", "_", text)
    printable = "".join(letter if letter.isprintable() else "_" for letter in plain)
    return printable.strip("_") or "part"


def list_words(text: str) -> frozenset[str]:
    """Return the words of a text, for comparison with those of names."""
    return frozenset(text.split())


# A word ends at a sign, a digit, or before a capital: "LWristYaw" is L, Wrist, Yaw. A letter with
# a number, as in "arm_l3", is one word.
_WORD = re.compile(r"(?<![A-Za-z])[A-Za-z]\d+|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
# Words that names join without a sign, as in "leftforearm"; parts of others, as "arm" in "charm"
# or "ear" in "bearing", are no words.
_PARTS = list_words(
    "left right front rear back fore upper lower inner outer mid middle top bottom main "
    "arm shoulder elbow wrist hand gripper lift flange finger thumb jaw knuckle claw grip tip pad "
    "palm base link joint motor servo drive roll pitch yaw pan tilt flex rotation "
    "leg hip knee ankle foot feet thigh calf shank toe head neck eye ear camera antenna tail torso "
    "wheel whl tyre tire caster castor steer steering omni mecanum swerve robot"
)
_SIDES = ("l", "r", "fl", "fr", "rl", "rr", "bl", "br", "lf", "lh", "rf", "rh")


def split_words(name: str) -> list[str]:
    """Return the words of a name in lower case, with compounds divided.

    "FL_thighJoint2" is fl, thigh, joint, 2; "leftforearm" left, fore, arm; "rwheel" r, wheel.
    """
    words = list[str]()
    for word in _WORD.findall(name):
        words += _divide_compound(word.lower()) or [word.lower()]
    return words


def _divide_compound(word: str, *, inside: bool = False) -> list[str]:
    """Return the known words of a compound, or [] if it has others."""
    singular = word.removesuffix("s")
    if word in _PARTS or singular in _PARTS:
        return [word if word in _PARTS else singular]
    starts = _PARTS if inside else _PARTS.union(_SIDES)
    for start in sorted(starts, key=len, reverse=True):
        if word.startswith(start):
            rest = _divide_compound(word[len(start) :], inside=True)
            if rest:
                return [start, *rest]
    return []
