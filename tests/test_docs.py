"""Tests that the code of the documentation runs, its links work, and its names exist."""

from __future__ import annotations

import argparse
import gzip
import inspect
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
import yaml

import vkc_pin as vkc
from vkc_pin.cli.commands import make_parser
from vkc_pin.validation.report import Violation
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


def find_blocks(page: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


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
)  # pages whose code runs for long


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


def test_readme_snippets_are_brief() -> None:
    snippets = find_blocks(ROOT / "README.md", "python")
    assert len(snippets) >= 2
    for code in snippets:
        assert len([line for line in code.splitlines() if line.strip()]) <= 10


def test_yaml_examples_fit_their_schemas(tmp_path: Path) -> None:
    room, measured, home = find_blocks(ROOT / "docs/scenes.md", "yaml")
    start = parse_document(Document(yaml.safe_load(measured)["start"]), StartSchema)
    assert "drawer" in start.held
    for scene, objects, allowed in ((room, ["drawer"], 0), (home, ["door"], 4)):
        (tmp_path / "room.yaml").write_text(scene, encoding="utf-8")
        loaded = vkc.load_scene(tmp_path / "room.yaml")
        assert (list(loaded.objects), len(loaded.allowed)) == (objects, allowed)
    described, rim, narrow, push, closer, rollers, whole = find_blocks(
        ROOT / "docs/objects.md", "yaml"
    )
    for text, urdf in (
        (rim, "bowl.urdf"),
        *((own, "drawer.urdf") for own in (narrow, push, rollers)),
        (closer, "door.urdf"),
    ):
        assert parse_document(Document(yaml.safe_load(text)), ObjectSchema).urdf == urdf
    included = ROOT / "scenes/objects"
    for text in (described, narrow, push, closer, rollers):
        assert vkc.load_object(yaml.safe_load(text), folder=included).attachments
    (tmp_path / "hatch.yaml").write_text(whole, encoding="utf-8")
    assert vkc.load_scene(tmp_path / "hatch.yaml").objects["hatch"].object.name == "hatch"
    assert parse_document(Document(yaml.safe_load(described)), ObjectSchema).urdf == "door.urdf"
    robot, telescope, wheels = find_blocks(ROOT / "docs/robots.md", "yaml")
    couplings = parse_document(Document(yaml.safe_load(telescope)), RobotSchema).couplings
    assert [coupling.joint for coupling in couplings.values()] == ["joint_arm_l3"] * 3
    base = parse_document(Document(yaml.safe_load(wheels)), RobotSchema).base
    assert base.wheels is not None
    assert (round(base.wheels.rim_speed, 3), base.turning_radius) == (1.0, 1.2)
    assert parse_document(Document(yaml.safe_load(robot)), RobotSchema).tool_frame == "tool"


def test_every_field_is_documented() -> None:
    scenes, objects, robots = (
        read("docs/scenes.md"),
        read("docs/objects.md"),
        read("docs/robots.md"),
    )
    kinds = ObstacleSchema.__origin__.__args__  # type: ignore[attr-defined]
    for text, schemas in (
        (scenes, (SceneSchema, SceneRobotSchema, StartSchema, PlacedObjectSchema, *kinds)),
        (objects, (ObjectSchema, ObjectJointSchema, AttachmentSchema, LatchSchema)),
        (robots, (RobotSchema,)),
    ):
        for schema in schemas:
            missing = [
                field for field in schema.model_fields if not re.search(rf"`{field}\b", text)
            ]
            assert not missing, (schema.__name__, missing)
    assert [field for field in BaseSchema.model_fields if f"`base.{field}`" not in robots] == []
    assert [colour for colour in COLOURS if not re.search(rf"\b{colour}\b", scenes)] == []


def test_every_option_of_load_robot_is_documented() -> None:
    text, function = read("docs/robots.md"), vkc.load_robot
    assert [name for name in function.__kwdefaults__ if f"`{name}`" not in text] == []


def test_every_constraint_and_status_is_documented() -> None:
    names = re.findall(
        r'"(\w+)"', (Violation.__doc__ or "").split("constraint:")[1].split("subject:")[0]
    )
    statuses = re.findall(
        r'"([\w ]+)"', (vkc.Plan.__doc__ or "").split("status:")[1].split("metrics:")[0]
    )
    assert len(names) >= 12
    assert len(statuses) >= 6
    for page, words in (
        ("docs/reading_failures.md", [*names, *statuses]),
        ("docs/formulation.md", names),
    ):
        assert [word for word in words if f"`{word}`" not in read(page)] == [], page


def find_commands() -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of all commands by name, such as "bench door"."""
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

    collect(make_parser(), "")
    return found


def test_every_command_and_option_is_documented() -> None:
    text = read("docs/cli.md")
    for name, parser in find_commands().items():
        section = text.split(f"## vkc-pin {name}")[1].split("\n## ")[0]
        options = {option for action in parser._actions for option in action.option_strings} - {
            "-h",
            "--help",
        }
        assert [option for option in options if option not in section] == [], name


def test_shell_commands_are_valid() -> None:
    lines = [
        line
        for page in PAGES
        for block in find_blocks(page, "sh")
        for line in block.splitlines()
        if line.startswith("vkc-pin")
    ]
    assert len(lines) >= 8
    parser = make_parser()
    for line in lines:
        words = line.partition("#")[0].split()[1:]
        assert callable(parser.parse_args(words).run), line
    targets = set(re.findall(r"^(\w+):", read("Makefile"), re.MULTILINE))
    assert (
        set(
            re.findall(
                r"^make (\w+)", "\n".join(find_blocks(ROOT / "README.md", "sh")), re.MULTILINE
            )
        )
        <= targets
    )


def test_commands_on_a_page_do_not_share_folders() -> None:
    """A folder belongs to one experiment."""
    for page in PAGES:
        commands = {
            line
            for block in find_blocks(page, "sh")
            for line in block.splitlines()
            if line.startswith(("vkc-pin bench", "vkc-pin generate"))
        }
        folders = re.findall(r"--out (?!DIR)(\S+)", "\n".join(commands))
        assert sorted(folders) == sorted(set(folders)), page.name


def test_every_command_has_help() -> None:
    for name, parser in find_commands().items():
        assert f"vkc-pin {name}" in parser.format_help()
    command = [sys.executable, "-m", "vkc_pin.cli", "plan", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "vkc-pin plan" in done.stdout


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


def find_toctree_entries(page: str) -> list[str]:
    """Return the entries of a page's toctrees, which may contain wildcards."""
    blocks = re.findall(r"```{toctree}\n(.*?)```", read(page), re.DOTALL)
    return [
        line for block in blocks for line in block.splitlines() if line and not line.startswith(":")
    ]


def test_every_page_is_in_the_contents() -> None:
    for folder, contents, min_count in (("docs", "_contents", 15), ("docs/api", "index", 6)):
        names = find_toctree_entries(f"{folder}/{contents}.md")
        pages = [
            page.stem
            for page in (ROOT / folder).glob("*.md")
            if page.stem not in ("index", contents)
        ]
        assert len(pages) >= min_count
        assert [page for page in pages if not any(fnmatch(page, name) for name in names)] == []
        assert [
            name
            for name in names
            if "*" not in name and not (ROOT / folder / f"{name}.md").resolve().is_file()
        ] == []


def find_documented(directive: str) -> set[str]:
    """Return the names documented by a directive, "auto*" for all except automodule."""
    pages = (page.read_text(encoding="utf-8") for page in (ROOT / "docs/api").glob("*.md"))
    found = [
        pair
        for page in pages
        for pair in re.findall(r"^\.\. (auto\w+):: vkc_pin\.(\S+)", page, re.MULTILINE)
    ]
    return {
        name
        for kind, name in found
        if fnmatch(kind, directive) and (kind == "automodule") == (directive == "automodule")
    }


def test_every_public_name_is_in_the_reference() -> None:
    public = {name for name in vkc.__all__ if not inspect.ismodule(getattr(vkc, name))}
    for package in ("datasets", "importing", "procedural"):
        public |= {f"{package}.{name}" for name in getattr(vkc, package).__all__}
    assert find_documented("auto*") == public


def test_every_module_is_in_the_reference_once() -> None:
    pages = runpy.run_path(str(ROOT / "docs/_ext/api_pages.py"))
    text = "".join(pages["page"](package, files) for package, files in pages["packages"]().items())
    found = re.findall(r"^\.\. automodule:: (\S+)", text, re.MULTILINE)
    modules = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for file in (ROOT / "vkc_pin").rglob("*.py")
    }
    assert len(found) == len(set(found))
    modules.remove("vkc_pin.cli.__main__")  # importing it runs it
    assert set(found) == {name.removesuffix(".__init__") for name in modules} - {"vkc_pin"}
    assert find_documented("automodule") == set()


def test_all_files_state_the_same_version() -> None:
    citation, project = (
        yaml.safe_load(read("CITATION.cff")),
        tomllib.loads(read("pyproject.toml"))["project"],
    )
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    assert (
        yaml.safe_load(read("tools/conda/recipe.yaml"))["context"]["version"] == citation["version"]
    )
    assert vkc.__version__ == project["version"]
    sections = re.findall(r"^## \[([^]]+)\]", read("CHANGELOG.md"), re.MULTILINE)
    assert next(name for name in sections if name != "Unreleased") == citation["version"]
    for page in ("README.md", "docs/installation.md"):
        assert set(re.findall(r"[Vv]ersion (\d+\.\d+\.\d+)", read(page))) == {citation["version"]}


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
    assert set(rows) == {
        file.name.removesuffix(".json.gz") for file in (ROOT / "docs/results").iterdir()
    }
    benchmarks = [name for name, command in rows.items() if not command.startswith("python")]
    commands = re.findall(r"`(vkc-pin bench [^`]+)`", read("docs/evidence.md"))[: len(benchmarks)]
    parser = make_parser()
    for name, line in zip(benchmarks, commands, strict=True):
        meta, arguments = (
            script["result"](name)["meta"],
            parser.parse_args(shlex.split(line)[1:]),
        )
        assert line.endswith(f"out/{name}.json" if name.startswith("door") else f"out/{name}")
        assert getattr(arguments, "seed", None) == meta.get("seed"), name
        counts = {
            key: getattr(arguments, key, None)
            for key in ("starts", "goals", "problems", "trials", "seeds")
        }
        for key, value in counts.items():
            recorded = meta.get("starts" if key == "trials" and "starts" in meta else key)
            if value is not None and isinstance(recorded, int):
                assert value == recorded, (name, key)


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
    trials = {
        name: json.loads(gzip.decompress((ROOT / f"docs/results/{name}.json.gz").read_bytes()))
        for name in ("household", "door_seed_0", "gap")
    }
    door = [t for t in trials["household"]["trials"] if (t["method"], t["scene"]) == ("B1", "door")]
    successes = sum(t["success"] for t in door)
    assert 0 < successes < len(door)
    assert figure("household successes method=B1 scene=door", "") == str(successes)
    assert figure("gap good", "") == f"{sum(t['success'] for t in trials['gap']['trials'])} of 50"
    times = [
        t["planning_time"] for t in trials["door_seed_0"]["trials"] if t["task"] == "push blind"
    ]
    median = figure("door_seed_0 median:planning_time task=push~blind", "0.00")
    assert median == f"{np.median(times):.2f}"


@pytest.mark.parametrize(
    ("asked", "before"),
    [("good gap", ""), ("door_seed_0 median:planning_time task=nothing", "0.0")],
)
def test_figures_without_record_or_trial_raise(asked: str, before: str) -> None:
    figure = runpy.run_path(str(ROOT / "docs/make_tables.py"))["figure"]
    with pytest.raises((ValueError, OSError)):
        figure(asked, before)


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
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-c",
        "docs",
        "-d",
        str(folder / "doctrees"),
        ".",
        str(folder / "html"),
    ]
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
    assert [
        name for name in find_documented("auto*") if f'id="vkc_pin.{name}"' not in reference
    ] == []
