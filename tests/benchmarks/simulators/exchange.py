"""Files and the command line that the scripts of all environments share; it needs NumPy alone.

A folder for each reset holds `model.xml` and `state.npz`, written where the environment is
installed, and `motion.npz`, written where vkc_pin is.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Motion:
    """A planned motion, with one sample for each action of the environment.

    Attributes:
        names: Names of the model's joints.
        positions: Their positions, shape (K, n), [m] and [rad].
        holding: Whether the hand holds something, shape (K,).
    """

    names: Sequence[str]
    positions: np.ndarray
    holding: np.ndarray

    def get_positions(self, joints: Sequence[str]) -> np.ndarray:
        """Return the positions of some joints, shape (K, m)."""
        return np.asarray(self.positions[:, [self.names.index(name) for name in joints]])

    def get_end(self, joint: str) -> float:
        """Return the last position of a joint."""
        return float(self.positions[-1, self.names.index(joint)])

    def iterate_actions(self, settle: int, close: int) -> Iterator[tuple[int, bool, bool]]:
        """Yield the sample of each action, whether the arm moves, and whether the hand is closed.

        Args:
            settle: Number of actions at rest before the hand closes, and at the end.
            close: Number of actions at rest while it closes.
        """
        was_holding = False
        for sample, holds in enumerate(self.holding.tolist()):
            if holds and not was_holding:
                for number in range(settle + close):
                    yield sample, False, number >= settle
            yield sample, True, holds
            was_holding = holds
        for _ in range(settle):
            yield len(self.positions) - 1, False, was_holding


def write_state(folder: Path, qpos: np.ndarray) -> None:
    """Write the positions of a reset, in the model's order."""
    np.savez(folder / "state.npz", qpos=qpos)


def read_state(folder: Path) -> np.ndarray:
    """Return the positions of a reset."""
    return np.asarray(np.load(folder / "state.npz")["qpos"])


def write_motion(folder: Path, motion: Motion) -> None:
    """Write the motion that was planned for a reset."""
    np.savez(
        folder / "motion.npz",
        names=list(motion.names),
        positions=motion.positions,
        holding=motion.holding,
    )


def read_motion(folder: Path, qpos: np.ndarray) -> Motion:
    """Return the motion that was planned for a reset.

    Raises:
        SystemExit: The environment has been reset to other positions `qpos`.
    """
    if not np.array_equal(read_state(folder), qpos):
        raise SystemExit(f"{folder}: the reset is another one")
    loaded = np.load(folder / "motion.npz")
    names = [str(name) for name in loaded["names"]]
    return Motion(names, loaded["positions"], loaded["holding"])


def run(
    export: Callable[[Path, int], None],
    execute: Callable[[Path, int], Mapping[str, object]],
) -> None:
    """Run the command line `export|execute FOLDER FIRST LAST` of an environment.

    Args:
        export: Writes model and state of a reset to a folder.
        execute: Executes the motion in a folder in this reset, and returns figures, among them
            `success`.
    """
    command, parent, first, last = sys.argv[1:]
    results = list[Mapping[str, object]]()
    for number in range(int(first), int(last)):
        folder = Path(parent) / f"{number:03d}"
        if command == "export":
            folder.mkdir(parents=True, exist_ok=True)
            export(folder, number)
            continue
        result: Mapping[str, object] = {"success": False, "reason": "no plan"}
        if (folder / "motion.npz").is_file():
            result = execute(folder, number)
        results.append({"number": number, **result})
        print(json.dumps(results[-1]), flush=True)
    if results:
        count = sum(bool(result["success"]) for result in results)
        print(f"{count} of {len(results)} succeeded")
        Path(parent, "results.json").write_text(json.dumps(results, indent=1))
