"""Command lines at random."""

from __future__ import annotations

import contextlib
import random
from typing import Any

from vkc_pin.cli import main

from .calls import files, folder
from .mutate import spoiled
from .odd import pipe

__all__ = ["case", "run"]

_TEXTS = (
    "",
    " ",
    "x",
    "-1",
    "0",
    "1",
    "nan",
    "inf",
    "1e300",
    "1e-300",
    "9" * 5000,
    "-",
    "--",
    "\x00",
    "a\ud800",
    "é",
    "x" * 5000,
    "/",
    "..",
    "0,2",
    "door.hinge=1",
)
_COMMANDS: dict[str, tuple[tuple[str, ...], dict[str, tuple[str, ...]]]] = {
    "plan": (
        ("door", "drawer", "scenes/door.yaml", "nowhere.yaml"),
        {
            "--set": (
                "door.hinge=1.2",
                "drawer.slide=0.2",
                "drawer.slide=nan",
                "drawer.slide",
                "=",
                ".=",
                "a.b=c",
                "drawer.slide=1e400",
            ),
            "--json": ("OUT/a.json",),
            "--save": ("OUT/a.npz", "OUT"),
            "--csv": ("OUT/a.csv", "/proc/x"),
            "--ros": ("OUT/a.ros", "OUT/pipe"),
            "--initialization": ("auto", "interpolated", "astr"),
            "--seed": ("0", "3", "-3"),
            "--quiet": (),
        },
    ),
    "check": (("NPZ", "nowhere.npz", "CSV"), {}),
    "view": (("NPZ", "drawer"), {"--html": ("OUT/a.html", "OUT/pipe", "/")}),
    "export": (
        ("NPZ", "CSV", "nowhere"),
        {
            "--csv": ("OUT/b.csv",),
            "--json": ("OUT/b.json",),
            "--ros": ("OUT/b.ros",),
            "--joints": ("all", "robot", "base_x", "base_x,base_y", ",", "x"),
            "--rate": ("10", "0", "-1", "1e6", "1e300"),
        },
    ),
    "srdf": (
        ("husky_ur5e", "nowhere.urdf"),
        {"--output": ("OUT/a.srdf",), "--samples": ("1", "20", "-1", "x"), "--seed": ("0",)},
    ),
    "bench": (("x", "--help", "dor"), {"--workers": ("x",)}),
    "": (("--version", "--help", "x"), {}),
}


def case(rng: random.Random) -> dict[str, Any]:
    """Return a case: the words of a command line."""
    command = rng.choice(tuple(_COMMANDS))
    wheres, options = _COMMANDS[command]
    words = [command] if command else []
    words += [_word(rng, wheres)] * rng.choice((1, 1, 1, 1, 1, 0, 2))
    for option in rng.sample(tuple(options), rng.randrange(len(options) + 1)):
        words += [option, *([_word(rng, options[option])] if options[option] else [])]
    if command == "plan":
        words += ["--time-limit", rng.choice(("0.1", "0.1", "0.1", "0.1", *_TEXTS[3:8]))]
        if "--set" not in words and rng.random() < 0.9:
            words += ["--set", "drawer.slide=0.2"]
    if command == "view" and "--html" not in words:
        words += ["--html", "OUT/c.html"]
    if command == "srdf" and "--samples" not in words:
        words += ["--samples", "5"]
    if rng.random() < 0.1 and len(words) > 1:
        words.insert(rng.randrange(1, len(words)), rng.choice(_TEXTS))
    return {"argv": words}


def _word(rng: random.Random, usual: tuple[str, ...]) -> str:
    if rng.random() < 0.65:
        return rng.choice(usual)
    if rng.random() < 0.5:
        return rng.choice(_TEXTS)
    return spoiled(rng, rng.choice(usual).encode(), 1).decode("latin-1")[:3000]


def run(given: dict[str, Any]) -> str:
    """Run the command, in a folder of its own."""
    out = folder() / "out"
    out.mkdir(exist_ok=True)
    known = {"NPZ": str(files()["npz"]), "CSV": str(files()["csv"]), "OUT/pipe": str(pipe())}
    words = [known.get(word, word.replace("OUT", str(out))) for word in given["argv"]]
    code: Any = None
    with contextlib.chdir(out):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    assert code in (0, 1, 2, 3), f"ended with {code!r}"
    return ("done", "failed", "refused", "infeasible")[code]
