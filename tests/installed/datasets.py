"""Writes a dataset of two episodes in all layouts, and reads it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from helpers.datasets import SMALL

import vkc_pin as vkc

COMMAND = Path(sys.executable).with_name("vkc-pin")
EPISODES = 2


def main() -> None:
    dataset = vkc.datasets.generate(SMALL, EPISODES, "small", lerobot=True)
    assert sum(episode.validate().ok for episode in dataset.episodes()) == EPISODES
    assert list(Path("small").rglob("*.parquet"))
    subprocess.run([COMMAND, "dataset", "check", "small"], check=True)


if __name__ == "__main__":
    main()
