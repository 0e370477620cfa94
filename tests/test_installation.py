"""Tests the wheel in a new environment with each extra alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.dependencies import SCRIPTS

CHECKOUT = Path(__file__).resolve().parents[1]
EXTRAS = {
    "": ["plan"],
    "cluster": ["distribute"],
    "completion": ["complete"],
    "data": ["datasets"],
    "experiments": ["baseline"],
    "import": ["imports", "meshes"],
    "notebook": ["show"],
    "ros": ["record"],
    "sim": ["simulate"],
    "usd": ["stage"],
}
"""Scripts that run in the environment of each extra; "" is the plain installation."""
NOT_TESTED = {"docs", "peers", "test"}  # `peers` is large and serves one experiment


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel as pip does, with the compiled modules."""
    folder = tmp_path_factory.mktemp("wheel")
    run("-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(CHECKOUT))
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture
def environment(tmp_path: Path) -> Iterator[Path]:
    """Create a virtual environment without pip, and delete it afterwards: it takes 1.6 GB."""
    folder = tmp_path / "environment"
    run("-m", "venv", "--without-pip", str(folder))
    yield folder
    shutil.rmtree(folder)


def run(*arguments: str, python: Path = Path(sys.executable), folder: Path | None = None) -> str:
    """Run Python without the checkout on its path, and return the output."""
    settings = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if folder is not None:
        settings |= {"PYTHONPATH": str(SCRIPTS.parent), "VKC_PIN_CACHE": str(folder / "cache")}
    done = subprocess.run(
        [python, *arguments], cwd=folder, env=settings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_extra_for_users_is_tested() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(EXTRAS) == {"", *project["optional-dependencies"]} - NOT_TESTED
    scripts = [name for names in EXTRAS.values() for name in names]
    assert sorted(scripts) == sorted(file.stem for file in SCRIPTS.glob("*.py"))


# 11 min on two idle cores with pip's cache: 2 min for the wheel, 1 to 1.5 min for each extra.
@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("extra", EXTRAS, ids=lambda extra: extra or "plain")
def test_extra_alone_suffices(extra: str, wheel: Path, environment: Path, tmp_path: Path) -> None:
    requirement = f"vkc-pin[{extra}] @ {wheel.as_uri()}" if extra else str(wheel)
    python = environment / "bin" / "python"
    options = ["--quiet", "--no-compile"]
    run("-m", "pip", "--python", str(python), "install", *options, requirement)
    for script in EXTRAS[extra]:
        folder = tmp_path / script
        folder.mkdir()
        location = run(
            "-c", "import vkc_pin; print(vkc_pin.__file__)", python=python, folder=folder
        )
        assert Path(location.strip()).is_relative_to(environment)
        run(str(SCRIPTS / f"{script}.py"), python=python, folder=folder)
