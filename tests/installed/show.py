"""Executes a notebook that plans and shows the motion."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell, new_notebook

COMMAND = Path(sys.executable).with_name("jupyter-execute")
PLAN = """import vkc_pin as vkc
plan = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
plan.show()"""
PLOT = "plan.plot()"


def main() -> None:
    nbformat.write(new_notebook(cells=[new_code_cell(PLAN), new_code_cell(PLOT)]), "drawer.ipynb")
    subprocess.run([COMMAND, "drawer.ipynb", "--inplace"], check=True)
    shown, plotted = nbformat.read("drawer.ipynb", as_version=4).cells
    assert "iframe" in str(shown.outputs)
    assert "image/png" in str(plotted.outputs)
    assert Path("drawer.ipynb").stat().st_size > 100_000


if __name__ == "__main__":
    main()
