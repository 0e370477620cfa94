from __future__ import annotations

import yaml

from vkc_pin.datasets.formats.card import make_card


def test_card_has_counts_and_failures() -> None:
    about = {
        "name": "home",
        "license": "CC-BY-4.0",
        "digest": "abc",
        "rate": 10.0,
        "versions": {"pin": "4.1"},
        "recipe": "name: home\n",
    }
    episode = {
        "task": "drive-open",
        "robot": "panda",
        "kind": "oven",
        "room": "room_1",
        "scene": "s",
        "duration": 1800.0,
    }
    failure = {"status": "infeasible", "reason": "the wall is in the way"}
    text = make_card(about, [episode, {**episode, "scene": "t"}], [failure, failure])
    _, head, body = text.split("---\n", 2)
    assert yaml.safe_load(head)["license"] == "cc-by-4.0"
    assert yaml.safe_load(head)["size_categories"] == ["n<1K"]
    for words in (
        "2 whole-body motions",
        "1.00 h",
        "`abc`",
        "50.0 % of which",
        "| pin | 4.1 |",
        "| robot panda | 2 |",
        "| scenes | 2 |",
    ):
        assert words in body, words
    assert "- infeasible: the wall is in the way (2)" in body
