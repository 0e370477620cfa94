"""Tests on a package with a fault: in processes that are forked off one that has everything else in memory already."""

from __future__ import annotations

import contextlib
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import inspect
import itertools
import json
import os
import resource
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from .mutations import Mutant

__all__ = ["Coverage", "measured", "outcome", "warm"]

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "vkc_pin"
# What takes long to import and has no fault: it is in memory before processes are forked off.
OTHERS = (
    "casadi", "coal", "hypothesis", "hypothesis.extra.numpy", "matplotlib", "meshcat", "numpy", "pink", "pinocchio", "pydantic",
    "qpsolvers", "scipy.optimize", "scipy.sparse", "scipy.spatial", "toppra", "trimesh", "yaml",
)  # fmt: skip
ALWAYS = (
    -1
)  # the "line" that everything runs that runs any of a module: what stands outside of functions
PATIENCE = 5  # times as long as the tests took without a fault, and
PATIENCE_SECONDS = 30  # [s] more: then the fault has made them endless, which is noticed as well


class Coverage:
    """Which tests execute which lines, and how long they take.

    Attributes:
        seconds: Test → CPU time [s].
        lines: "module:line" → the tests that execute it.
    """

    def __init__(self, seconds: dict[str, float], lines: dict[str, list[str]]) -> None:
        self.seconds, self.lines = seconds, lines

    def tests_of(self, mutant: Mutant, most: float) -> list[str]:
        """Return the tests that execute a changed line: those of the module's own files, then others, files that are quick first.

        Those whose names begin as the module's do are its own: test_sweep.py and test_sweep_line.py
        are sweep.py's.

        Args:
            mutant: The fault. One outside of functions is in the lines that use what is defined
                there.
            most: CPU time that they may take together [s]; those that are left out are the last.
        """
        found = {
            test for line in mutant.lines for test in self.lines.get(f"{mutant.module}:{line}", [])
        }
        mine = f"tests/{Path(mutant.module).with_suffix('').parent}/test_{Path(mutant.module).stem}"
        own = {
            file
            for file in map(_file, self.seconds)
            if file == f"{mine}.py" or file.startswith(f"{mine}_")
        }
        if mutant.lines != (mutant.line,):  # a constant, which tests may look at themselves
            own_tests = {test for test in self.seconds if _file(test) in own}
            found |= own_tests | (
                set() if found else set(self.lines.get(f"{mutant.module}:{ALWAYS}", []))
            )
        whole: dict[str, float] = defaultdict(float)
        for test in found:
            whole[_file(test)] += self.seconds[test]
        order = sorted(
            found,
            key=lambda test: (
                _file(test) not in own,
                whole[_file(test)],
                _file(test),
                self.seconds[test],
            ),
        )
        spent = list(itertools.accumulate(self.seconds[test] for test in order))
        return [
            test
            for test, until in zip(order, spent, strict=True)
            if until <= most or test == order[0]
        ]


def _file(test: str) -> str:
    return test.partition("::")[0]


def warm() -> None:
    """Import what has no fault."""
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", VKC_PIN_CACHE="off")
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(ROOT / "out" / "mutants" / "bytecode")
    for name in OTHERS:
        importlib.import_module(name)
    assert not [name for name in sys.modules if name.partition(".")[0] == "vkc_pin"]


def _forked(work: Callable[[], int], log: Path, cpu: float | None) -> tuple[int | None, float]:
    """Do something in a process of its own; return its exit status, None where it took more than its time, and CPU time [s]."""
    sys.stdout.flush()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    child = os.fork()
    if not child:
        status = 70
        with contextlib.suppress(BaseException):
            os.setsid()
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(out, 1)
            os.dup2(out, 2)
            if cpu is not None:
                resource.setrlimit(resource.RLIMIT_CPU, (int(cpu) + 1, int(cpu) + 5))
            status = work()
        os._exit(status)
    ended = threading.Event()
    if cpu is not None:  # what waits for ever takes no CPU time

        def stop() -> None:
            if not ended.wait(20 * cpu):
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)

        threading.Thread(target=stop, daemon=True).start()
    _, code = os.waitpid(child, 0)
    ended.set()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    took = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return (os.waitstatus_to_exitcode(code) if os.WIFEXITED(code) else None), took


def _pytest(paths: Sequence[str], *plugins: object) -> int:
    os.chdir(ROOT)
    own = ["-x", "-q", "--tb=line", "-p", "no:cacheprovider", "-m", "not long and not browser"]
    return int(pytest.main([*own, *paths], plugins=list(plugins)))


# ---- which tests execute what


class _Recorder:
    """Notes which lines of some modules run in which test, and in what was set up for it."""

    def __init__(self, modules: Sequence[str]) -> None:
        self.modules = {str(PACKAGE / module): module for module in modules}
        self.now: set[str] = set()
        self.at_import: set[str] = (
            set()
        )  # in functions that a file of tests calls before any of them runs
        self.of_test: dict[str, set[str]] = {}
        self.of_fixture: dict[str, set[str]] = defaultdict(set)
        self.fixtures: dict[str, list[str]] = {}
        self.seconds: dict[str, float] = {}

    def trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        module = self.modules.get(frame.f_code.co_filename)
        if module is None or (
            self.now is self.at_import and not frame.f_code.co_flags & inspect.CO_OPTIMIZED
        ):
            return None
        self.now.add(f"{module}:{ALWAYS}")
        self.now.add(f"{module}:{frame.f_lineno}")

        def local(frame: FrameType, event: str, argument: Any) -> Any:
            self.now.add(f"{module}:{frame.f_lineno}")
            return local

        return local

    @contextlib.contextmanager
    def into(self, lines: set[str]) -> Iterator[None]:
        before, self.now = self.now, lines
        sys.settrace(self.trace)
        try:
            yield
        finally:
            self.now = before
            sys.settrace(self.trace if before else None)

    @pytest.hookimpl(hookwrapper=True)
    def pytest_make_collect_report(self) -> Iterator[None]:
        with self.into(self.at_import):
            yield

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        with self.into(self.of_fixture[fixturedef.argname]):
            yield

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        begin = time.process_time()
        with self.into(self.of_test.setdefault(item.nodeid, {""})):
            yield
        self.fixtures[item.nodeid] = list(item.fixturenames)
        self.seconds[item.nodeid] = time.process_time() - begin

    def coverage(self) -> dict[str, Any]:
        lines = defaultdict(list)
        for test, own in self.of_test.items():
            for line in own.union(
                self.at_import, *(self.of_fixture.get(name, set()) for name in self.fixtures[test])
            ) - {""}:
                lines[line].append(test)
        return {"seconds": self.seconds, "lines": lines}


def measured(modules: Sequence[str], tests: Sequence[str], folder: Path) -> Coverage:
    """Run tests without a fault, each file in a process of its own; return what they execute. What is known of a file is kept.

    Raises:
        SystemExit: A test fails without any fault.
    """
    seconds: dict[str, float] = {}
    lines: dict[str, list[str]] = defaultdict(list)
    folder.mkdir(parents=True, exist_ok=True)
    files = [
        file
        for name in tests
        for file in (
            [ROOT / name] if name.endswith(".py") else sorted((ROOT / name).rglob("test_*.py"))
        )
    ]
    for file in files:
        name = str(file.relative_to(ROOT))
        kept = folder / f"{name.replace('/', '.')}.json"
        newest = max(
            path.stat().st_mtime for path in (file, *(PACKAGE / module for module in modules))
        )
        if not kept.is_file() or kept.stat().st_mtime < newest:
            sys.stdout.write(f"runs {name} without a fault\n")

            def work(name: str = name, kept: Path = kept) -> int:
                recorder = _Recorder(modules)
                code = _pytest([name], recorder)
                if code in (0, 5):
                    kept.write_text(json.dumps(recorder.coverage()))
                return code

            code, _ = _forked(work, folder / "log.txt", None)
            if code not in (0, 5):
                raise SystemExit(
                    f"{name} fails without a fault:\n{(folder / 'log.txt').read_text()}"
                )
        found = json.loads(kept.read_text())
        seconds.update(found["seconds"])
        for line, own in found["lines"].items():
            lines[line] += own
    return Coverage(seconds, lines)


# ---- with a fault


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module with another source than its file's."""

    source = ""

    def get_code(self, fullname: str) -> Any:
        return compile(self.source, self.path, "exec", dont_inherit=True)


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the module with the fault."""

    def __init__(self, mutant: Mutant) -> None:
        self.path = PACKAGE / mutant.module
        self.name = "vkc_pin." + mutant.module.removesuffix(".py").replace("/", ".")
        self.source = mutant.source

    def find_spec(
        self, fullname: str, path: Any, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self.name:
            return None
        loader = _Loader(fullname, str(self.path))
        loader.source = self.source
        return importlib.util.spec_from_file_location(fullname, self.path, loader=loader)


class _Chosen:
    """Runs these tests, in this order."""

    def __init__(self, tests: Sequence[str]) -> None:
        self.order = {test: k for k, test in enumerate(tests)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = sorted(
            (item for item in items if item.nodeid in self.order),
            key=lambda item: self.order[item.nodeid],
        )


def outcome(mutant: Mutant, coverage: Coverage, log: Path, most: float) -> dict[str, Any]:
    """Run tests that execute a changed line, for so much CPU time at most [s]; return what came of it, and what that took.

    "killed": a test fails. "endless": they take much longer than without the fault. "survived": no
    test notices. "uncovered": no test executes that line.
    """
    tests = coverage.tests_of(mutant, most)
    if not tests:
        return {"outcome": "uncovered", "tests": 0, "seconds": 0.0}

    def work() -> int:
        sys.meta_path.insert(0, _Finder(mutant))
        return _pytest(list(dict.fromkeys(map(_file, tests))), _Chosen(tests))

    limit = PATIENCE_SECONDS + PATIENCE * sum(coverage.seconds[test] for test in tests)
    code, seconds = _forked(work, log, limit)
    found = "endless" if code is None else "survived" if code == 0 else "killed"
    failed = [
        line
        for line in log.read_text(errors="replace").splitlines()
        if line.startswith(("FAILED", "ERROR"))
    ]
    by = failed[0].split()[1] if failed else ""
    return {"outcome": found, "tests": len(tests), "seconds": round(seconds, 1), "by": by}
