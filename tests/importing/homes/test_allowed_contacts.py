"""Tests which contacts of an imported home its SRDF allows."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.expected_errors import expect_error
from helpers.telescopes import format_joint, format_link
from helpers.texts import format_box, format_fixed_link

import vkc_pin as vkc


def disable(one: str, other: str) -> str:
    return f'<disable_collisions link1="{one}" link2="{other}"/>'


BOTH = disable("front", "top") + disable("handle", "top")


def format_chest() -> str:
    """Return a drawer that rises by 2.5° below a table top: they touch after some 20 mm."""
    parts = [
        format_link("room"),
        format_fixed_link("chest", "room", "2.5 0 0", format_box("0.4 0.6 0.6", "0 0 0.3")),
        format_fixed_link("top", "room", "2.4 0 0.785", format_box("0.8 0.7 0.03")),
        format_link("front", "0.02 0.6 0.18"),
        format_fixed_link("handle", "front", "-0.07 0 -0.06", format_box("0.02 0.2 0.02")),
        format_joint(
            "slide", "prismatic", "chest", "front", "-0.22 0 0.68", "-0.999 0 0.044", (0.0, 0.3)
        ),
    ]
    return f'<robot name="chest">{"".join(parts)}</robot>'


def import_chest(
    folder: Path, semantics: str, *, beside: bool = True
) -> vkc.importing.ImportedHome:
    (folder / "urdf").mkdir()
    (folder / "urdf" / "chest.urdf").write_text(format_chest())
    (folder / "srdf").mkdir()
    srdf = folder / "srdf" / ("chest.srdf" if beside else "other.srdf")
    srdf.write_text(f"<robot name='chest'>{semantics}</robot>")
    given = {} if beside else {"srdf": srdf}
    return vkc.importing.import_home(folder / "urdf" / "chest.urdf", folder / "home", **given)


@pytest.mark.parametrize("beside", [True, False])
def test_drawer_may_touch_what_the_srdf_of_the_home_allows(tmp_path: Path, beside: bool) -> None:
    home = import_chest(tmp_path, BOTH, beside=beside)
    assert home.scene.allowed.keys() == {frozenset(("chest.front", "top"))}
    plan = vkc.plan(home.scene, [vkc.Actuate("chest", {"slide": 0.2})])
    assert plan.success, plan.summary()


@pytest.mark.parametrize(
    ("semantics", "pairs", "note"),
    [
        (BOTH, 1, "1 pairs that may touch"),
        (disable("front", "top"), 0, "chest.front – top"),
        ('<disable_default_collisions link="top"/>', 2, "2 pairs that may touch"),
        (BOTH + disable("front", "knob"), 1, "does not have: knob"),
        (f'{BOTH}<handle name="pull" clearance="0.05"><link name="handle"/></handle>', 1, "pull"),
        (disable("front", "chest"), 0, ""),
        (disable("door", "wall"), 0, "ignored chest.srdf"),
        ("", 0, ""),
    ],
)
def test_pairs_of_merged_links_are_allowed_if_all_of_them_are(
    tmp_path: Path, semantics: str, pairs: int, note: str
) -> None:
    home = import_chest(tmp_path, semantics)
    assert len(home.scene.allowed) == pairs
    srdf_notes = [text for text in home.notes if "chest.srdf" in text]
    assert bool(srdf_notes) == bool(note)
    assert note in "\n".join(srdf_notes)


def test_given_srdf_of_another_home_is_an_error(tmp_path: Path) -> None:
    with expect_error("names no pair of links of this home"):
        import_chest(tmp_path, disable("door", "wall"), beside=False)
