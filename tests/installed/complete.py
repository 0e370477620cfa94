"""Writes completion for a shell."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

COMMAND = [sys.executable, "-m", "vkc_pin.cli", "completion", "bash"]


def main() -> None:
    script = subprocess.run(COMMAND, capture_output=True, text=True, check=True).stdout
    Path("completion.bash").write_text(script, encoding="utf-8")
    subprocess.run(["bash", "-n", "completion.bash"], check=True)


if __name__ == "__main__":
    main()
