"""Plans the door scene on the command line, and writes every format that needs no extra."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import vkc_pin as vkc

COMMAND = Path(sys.executable).with_name("vkc-pin")
OUTPUTS = ("html", "save", "json", "csv", "ros", "plots")


def run_command(*arguments: str) -> None:
    subprocess.run([COMMAND, *arguments], check=True)


def main() -> None:
    files = {"html": "door.html", "save": "door.npz", "plots": "plots"}
    files |= {name: f"door.{name}" for name in OUTPUTS if name not in files}
    options = [word for name, file in files.items() for word in (f"--{name}", file)]
    run_command("plan", "door", "--set", "door.hinge=1.2", "--quiet", *options)
    for file in files.values():
        assert Path(file).exists(), file
    assert vkc.Plan.load("door.npz").success
    run_command("check", "door.npz")
    run_command("check", "drawer", "--plot", "drawer.png")
    run_command("doctor", "husky_ur5e")


if __name__ == "__main__":
    main()
