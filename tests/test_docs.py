"""Tests that the code of the documentation runs, its links work, and its names exist."""

from __future__ import annotations

import argparse
import gzip
import importlib
import inspect
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
import yaml

import vkc_pin as vkc
from tests.benchmarks import commands
from vkc_pin import Violation
from vkc_pin.cli.commands import make_parser
from vkc_pin.world.files.documents import Document, parse_document
from vkc_pin.world.models.dynamics import ObjectJointSchema
from vkc_pin.world.models.object_file import AttachmentSchema, LatchSchema, ObjectSchema
from vkc_pin.world.models.robot_schema import BaseSchema, RobotSchema
from vkc_pin.world.scene.scene_schema import (
    COLOURS,
    ObstacleSchema,
    PlacedObjectSchema,
    SceneRobotSchema,
    SceneSchema,
    StartSchema,
)

ROOT = Path(__file__).resolve().parents[1]
DECISIONS = sorted((ROOT / "docs" / "decisions").glob("*.md"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def find_blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", read(page), re.MULTILINE | re.DOTALL)


def find_shell_lines(page: Path) -> list[str]:
    blocks = find_blocks(str(page), "sh")
    return [line for block in blocks for line in block.splitlines()]


# Pages whose code runs for long
LONG_PAGES = (
    "baselines",
    "chores",
    "datasets",
    "execution",
    "household",
    "index",
    "initialization",
    "objects",
    "own_terms",
    "reading_failures",
    "robots",
    "tutorial",
)


def find_snippets() -> list[object]:
    """Return the Python snippets of all pages, each with the output shown in its section."""
    pattern = r"^```python\n(.*?)^```$(?:(?:(?!^```|^#).)*^```text\n(.*?)^```$)?"
    return [
        pytest.param(
            *code,
            id=f"{page.stem}-{number}",
            marks=[pytest.mark.long] if page.stem in LONG_PAGES else [],
        )
        for page in PAGES
        for number, code in enumerate(re.findall(pattern, page.read_text("utf-8"), re.M | re.S))
    ]


@pytest.mark.parametrize(("code", "expected"), find_snippets())
def test_python_snippets_run_and_print_the_shown_output(
    code: str,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "documentation", "exec"), names)  # trusted code of this repository
    printed = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    for line in expected.replace("...", "").splitlines():  # numbers differ between machines
        prefix = " ".join(re.split(r"\d", line)[0].split()[:3])
        assert any(text.startswith(prefix) for text in printed), line
    for file in re.findall(r'\.(?:to_html|save)\("([^"]+)"\)', code):
        assert (tmp_path / file).is_file()
    plan = names.get("plan")
    if isinstance(plan, vkc.Plan):
        assert plan.success, plan.summary()


def parse_yaml(text: str, schema: type) -> Any:
    return parse_document(Document(yaml.safe_load(text)), schema)


def test_yaml_examples_fit_their_schemas(tmp_path: Path) -> None:
    room, measured, home = find_blocks("docs/scenes.md", "yaml")
    start = parse_document(Document(yaml.safe_load(measured)["start"]), StartSchema)
    assert "drawer" in start.held
    for scene, objects, allowed in ((room, ["drawer"], 0), (home, ["door"], 4)):
        (tmp_path / "room.yaml").write_text(scene, encoding="utf-8")
        loaded = vkc.load_scene(tmp_path / "room.yaml")
        assert (list(loaded.objects), len(loaded.allowed)) == (objects, allowed)
    described, rim, narrow, push, closer, rollers, whole = find_blocks("docs/objects.md", "yaml")
    urdfs = {described: "door", rim: "bowl", closer: "door"}
    urdfs |= dict.fromkeys((narrow, push, rollers), "drawer")
    for text, name in urdfs.items():
        assert parse_yaml(text, ObjectSchema).urdf == f"{name}.urdf"
        if text != rim:
            item = vkc.load_object(yaml.safe_load(text), folder=ROOT / "scenes/objects")
            assert item.attachments
    (tmp_path / "hatch.yaml").write_text(whole, encoding="utf-8")
    assert vkc.load_scene(tmp_path / "hatch.yaml").objects["hatch"].object.name == "hatch"
    robot, telescope, wheels = find_blocks("docs/robots.md", "yaml")
    couplings = parse_yaml(telescope, RobotSchema).couplings
    assert [coupling.joint for coupling in couplings.values()] == ["joint_arm_l3"] * 3
    base = parse_yaml(wheels, RobotSchema).base
    assert (round(base.wheels.rim_speed, 3), base.turning_radius) == (1.0, 1.2)
    assert parse_yaml(robot, RobotSchema).tool_frame == "tool"


def test_every_field_is_documented() -> None:
    scenes, objects, robots = (read(f"docs/{name}.md") for name in ("scenes", "objects", "robots"))
    kinds = ObstacleSchema.__origin__.__args__  # type: ignore[attr-defined]
    for text, schemas in (
        (scenes, (SceneSchema, SceneRobotSchema, StartSchema, PlacedObjectSchema, *kinds)),
        (objects, (ObjectSchema, ObjectJointSchema, AttachmentSchema, LatchSchema)),
        (robots, (RobotSchema,)),
    ):
        for schema in schemas:
            names = schema.model_fields
            assert [name for name in names if not re.search(rf"`{name}\b", text)] == [], schema
    assert [name for name in BaseSchema.model_fields if f"`base.{name}`" not in robots] == []
    assert [name for name in vkc.load_robot.__kwdefaults__ if f"`{name}`" not in robots] == []
    assert [colour for colour in COLOURS if not re.search(rf"\b{colour}\b", scenes)] == []


def test_every_constraint_and_status_is_documented() -> None:
    def find_names(text: str | None, begin: str, end: str) -> list[str]:
        return re.findall(r'"([\w ]+)"', (text or "").split(begin)[1].split(end)[0])

    names = find_names(Violation.__doc__, "constraint:", "subject:")
    statuses = find_names(vkc.Plan.__doc__, "status:", "metrics:")
    assert len(names) >= 12
    assert len(statuses) >= 6
    failures, formulation = read("docs/reading_failures.md"), read("docs/formulation.md")
    assert [word for word in (*names, *statuses) if f"`{word}`" not in failures] == []
    assert [word for word in names if f"`{word}`" not in formulation] == []


def find_commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of all commands of a parser by name, such as "bench door"."""
    found: dict[str, argparse.ArgumentParser] = {}

    def collect(parser: argparse.ArgumentParser, prefix: str) -> None:
        inner = [
            action for action in parser._actions if isinstance(action, argparse._SubParsersAction)
        ]
        for action in inner:
            for name, child in action.choices.items():
                collect(child, f"{prefix} {name}".strip())
        if not inner:
            found[prefix] = parser

    collect(parser, "")
    return found


@pytest.mark.parametrize(
    ("page", "parser", "heading"),
    [
        ("docs/cli.md", make_parser(), "vkc-pin "),
        ("docs/benchmark_commands.md", commands.make_parser(), ""),
    ],
    ids=["vkc-pin", "benchmarks"],
)
def test_every_command_and_option_is_documented(
    page: str, parser: argparse.ArgumentParser, heading: str
) -> None:
    text = read(page)
    for name, command in find_commands(parser).items():
        assert f"{heading}{name}" in command.format_help()
        section = text.split(f"\n## {heading}{name}")[1].split("\n## ")[0]
        options = {option for action in command._actions for option in action.option_strings}
        assert [one for one in options - {"-h", "--help"} if one not in section] == [], name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_shell_commands_are_valid_and_do_not_share_folders(page: Path) -> None:
    """A folder belongs to one experiment."""
    parsers = {"vkc-pin ": make_parser(), "python -m tests.benchmarks ": commands.make_parser()}
    lines = {line for line in find_shell_lines(page) if line.startswith(tuple(parsers))}
    for line in lines:
        program = next(program for program in parsers if line.startswith(program))
        words = line.removeprefix(program).partition("#")[0].split()
        assert callable(parsers[program].parse_args(words).run), line
    experiments = [line for line in lines if re.match(r"vkc-pin (bench|generate)|python", line)]
    folders = re.findall(r"--out (?!DIR)(\S+)", "\n".join(experiments))
    assert len(folders) == len(set(folders))


def test_make_targets_of_the_readme_exist() -> None:
    targets = set(re.findall(r"^(\w+):", read("Makefile"), re.MULTILINE))
    readme = "\n".join(find_shell_lines(ROOT / "README.md"))
    assert set(re.findall(r"^make (\w+)", readme, re.MULTILINE)) <= targets


@pytest.mark.parametrize("page", [*PAGES, *DECISIONS], ids=lambda page: page.name)
def test_links_have_targets(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{page.name}: {target}"
        if anchor:
            titles = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {
                re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles
            }, target


def find_documented() -> set[str]:
    """Return the names documented by the directives of the reference."""
    pages = "".join(read(str(page)) for page in (ROOT / "docs/api").glob("*.md"))
    return set(re.findall(r"^\.\. auto\w+:: vkc_pin\.(\S+)", pages, re.MULTILINE))


# Packages with public names that are not in `vkc_pin` itself.
PUBLIC_PACKAGES = (
    "datasets",
    "execution",
    "experiments.baselines",
    "importing",
    "procedural",
    "simulation",
    "validation",
    "visualization",
    "visualization.plots",
)


def find_public_names() -> set[str]:
    """Return the names of functions and classes that the packages' faces list."""
    public = {name for name in vkc.__all__ if not inspect.ismodule(getattr(vkc, name))}
    public |= {f"cpin.{name}" for name in vkc.cpin.__all__}
    for package in PUBLIC_PACKAGES:
        module = importlib.import_module(f"vkc_pin.{package}")
        members = {name: getattr(module, name) for name in module.__all__}
        public |= {f"{package}.{name}" for name, member in members.items() if callable(member)}
    return public - {"simulation.Physics", "simulation.SimulationResult"}  # of `vkc_pin`, too


def test_every_public_name_is_in_the_reference() -> None:
    assert find_documented() == find_public_names()


def test_all_files_state_the_same_version() -> None:
    project = tomllib.loads(read("pyproject.toml"))["project"]
    citation = yaml.safe_load(read("CITATION.cff"))
    recipe = yaml.safe_load(read("tools/conda/recipe.yaml"))["context"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    sections = re.findall(r"^## \[([^]]+)\]", read("CHANGELOG.md"), re.MULTILINE)
    latest = next(name for name in sections if name != "Unreleased")
    assert {recipe["version"], vkc.__version__, latest} == {project["version"]}
    for page in ("README.md", "docs/installation.md"):
        stated = re.findall(r"[Vv]ersion (\d+\.\d+\.\d+)", read(page))
        assert set(stated) == {project["version"]}


def test_tables_agree_with_the_recorded_results() -> None:
    script = runpy.run_path(str(ROOT / "docs/make_tables.py"))
    assert {page.name for page in script["PAGES"]} >= {"README.md", "benchmarks.md", "household.md"}
    for page in script["PAGES"]:
        text = page.read_text(encoding="utf-8")
        assert text == script["update_page"](text), page.name
        for name in re.findall(r"<!-- figures: (\w+) -->", text):
            assert f"<!-- /figures: {name} -->" in text


def test_every_record_has_a_claim_and_the_command_that_reproduces_it() -> None:
    script = runpy.run_path(str(ROOT / "docs/make_tables.py"))
    rows = {entry["record"]: entry["command"] for entry in script["RECORDS"]}
    assert len(rows) == len(script["RECORDS"])
    files = (ROOT / "docs/results").iterdir()
    assert set(rows) == {file.name.removesuffix(".json.gz") for file in files}
    parsers = {"vkc-pin ": make_parser(), "python -m tests.benchmarks ": commands.make_parser()}
    stated = re.findall(r"`((?:vkc-pin bench|python -m) [^`]+)`", read("docs/evidence.md"))
    for name, line in zip(rows, stated[: len(rows)], strict=True):
        program = next((program for program in parsers if line.startswith(program)), None)
        if program is None:
            continue  # a command of its own
        meta = script["result"](name)["meta"]
        words = shlex.split(line.removeprefix(program))
        arguments = vars(parsers[program].parse_args(words))
        assert line.endswith(f"out/{name}.json" if name.startswith("door") else f"out/{name}")
        assert arguments.get("seed") == meta.get("seed"), name
        for key in ("starts", "goals", "problems", "trials", "seeds"):
            recorded = meta.get("starts" if key == "trials" and "starts" in meta else key)
            if arguments.get(key) is not None and isinstance(recorded, int):
                assert arguments[key] == recorded, (name, key)


def test_figures_in_sentences_are_between_marks_of_their_source() -> None:
    """Rates and times come from a record, or state when they were measured."""
    marks = r"<!-- (figures?|measured): (?:.*?)-->.*?<!-- (?:/figures: \w+|/measured|/) -->"
    claims = r"\b\d+ of \d+\b|\d s in the median|\d s at the 95th|\d times as (?:slow|fast|long)"
    for page in PAGES:
        text = re.sub(
            r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
        )
        assert re.findall(claims, re.sub(marks, "", text, flags=re.DOTALL)) == [], page.name
        assert text.count("<!-- measured: ") == text.count("<!-- /measured -->"), page.name
        assert text.count("<!-- figure: ") == text.count("<!-- / -->"), page.name


def test_figures_are_computed_from_the_trials_of_a_record() -> None:
    figure = runpy.run_path(str(ROOT / "docs/make_tables.py"))["figure"]

    def read_trials(name: str) -> list[dict[str, Any]]:
        data = (ROOT / f"docs/results/{name}.json.gz").read_bytes()
        return json.loads(gzip.decompress(data))["trials"]

    trials = [t for t in read_trials("household") if (t["method"], t["scene"]) == ("B1", "door")]
    successes = sum(t["success"] for t in trials)
    assert 0 < successes < len(trials)
    assert figure("household successes method=B1 scene=door", "") == str(successes)
    assert figure("gap good", "") == f"{sum(t['success'] for t in read_trials('gap'))} of 50"
    trials = [t for t in read_trials("door_seed_0") if t["task"] == "push blind"]
    median = figure("door_seed_0 median:planning_time task=push~blind", "0.00")
    assert median == f"{np.median([t['planning_time'] for t in trials]):.2f}"
    for asked in ("good gap", "door_seed_0 median:planning_time task=nothing"):
        with pytest.raises((ValueError, OSError)):
            figure(asked, "0.0")


class Links(HTMLParser):
    """Collects the links, the loaded files and the anchors of a page of the site."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.loaded: set[str] = set()
        self.ids: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.ids.add(values.get("id", ""))
        if tag == "a" and "href" in values:
            self.links.add(values["href"])
        elif tag == "link" and values.get("rel") not in (
            "stylesheet",
            "preload",
            "icon",
            "modulepreload",
        ):
            return
        elif tag in ("script", "img", "iframe", "link", "source", "video"):
            self.loaded.add(values.get("src", values.get("href", "")))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site with warnings as errors, and return its folder."""
    pytest.importorskip(
        "sphinx", reason="the documentation is built with Sphinx: pip install '.[docs]'"
    )
    folder = tmp_path_factory.mktemp("site")
    options = ["-q", "-W", "--keep-going", "-c", "docs", "-d", str(folder / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *options, ".", str(folder / "html")]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "html"


@pytest.mark.long
@pytest.mark.timeout(600)
def test_site_is_complete_and_loads_no_external_files(site: Path) -> None:
    pages = {
        page.resolve(): Links(page)
        for page in site.rglob("*.html")
        if page.parent.name != "animations"
    }
    assert len(pages) >= 40
    for page, found in pages.items():
        for target in found.loaded:
            assert not urlsplit(target).netloc, f"{page.name} loads {target}"
        for target in found.links | found.loaded:
            parts = urlsplit(target)
            if parts.scheme in ("http", "https", "data", "mailto") or not (
                parts.path or parts.fragment
            ):
                continue
            file = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            assert file.is_file(), f"{page.name} links to {target}"
            if parts.fragment and file in pages:
                assert unquote(parts.fragment) in pages[file].ids, f"{page.name} links to {target}"
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), (
            sheet.name
        )
    start = (site / "docs/index.html").read_text(encoding="utf-8")
    assert "animations/door.html" in start
    assert (site / "docs/animations/door.html").stat().st_size > 100_000
    formulas = (site / "docs/formulation.html").read_text(encoding="utf-8")
    assert formulas.count('<svg class="formula"') > 100
    reference = "".join(
        page.read_text(encoding="utf-8") for page in (site / "docs/api").glob("*.html")
    )
    assert [name for name in find_documented() if f'id="vkc_pin.{name}"' not in reference] == []


@pytest.mark.parametrize("contents", ["docs/_contents.md", "docs/api/index.md"])
def test_every_page_is_in_the_contents(contents: str) -> None:
    path = ROOT / contents
    entries = [
        entry.strip() for block in find_blocks(contents, "{toctree}") for entry in block.split()
    ]
    listed = {page for entry in entries for page in path.parent.glob(f"{entry}.md")}
    assert set(path.parent.glob("*.md")) - listed <= {path, path.parent / "index.md"}
