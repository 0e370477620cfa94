"""Provides pytest plugins that record executed lines, or run selected tests with a fault."""

from __future__ import annotations

import faulthandler
import importlib.abc
import importlib.machinery
import importlib.util
import json
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

__all__ = ["PACKAGE", "Recorder", "Replacer"]

PACKAGE = Path(__file__).resolve().parents[2] / "vkc_pin"
GRACE = 60.0  # [s] for importing the package and collecting the tests


class Recorder:
    """Writes test → [CPU time [s], module → executed lines].

    Lines that are executed when the package is imported belong to the test "".
    """

    def __init__(self, record: Path) -> None:
        import coverage

        self.record, self.seconds = record, dict[str, float]()
        self.coverage = coverage.Coverage(
            data_file=None, config_file=False, include=[f"{PACKAGE}/*"]
        )
        self.coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self.coverage.switch_context(item.nodeid)
        start_time = time.process_time()
        result = yield
        self.seconds[item.nodeid] = time.process_time() - start_time
        self.coverage.switch_context("")
        return result

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        self.coverage.stop()
        if exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            return
        data = self.coverage.get_data()
        tests = {test: [seconds, {}] for test, seconds in {"": 0.0, **self.seconds}.items()}
        for file in data.measured_files():
            module = str(Path(file).relative_to(PACKAGE))
            for line, names in data.contexts_by_lineno(file).items():
                for name in names:
                    tests[name][1].setdefault(module, []).append(line)
        self.record.write_text(json.dumps(tests), encoding="utf-8")


class Replacer(importlib.abc.MetaPathFinder):
    """Imports a module of the package from another source, and runs selected tests only.

    Args:
        module: Path in the package, such as "planning/solver/loop.py".
        source: Source code that replaces the module's.
        limits: Id of each test → its time limit [s], in the order of execution.
    """

    def __init__(self, module: str, source: str, limits: Mapping[str, float]) -> None:
        self.name = "vkc_pin." + module.removesuffix(".py").replace("/", ".")
        self.module, self.source, self.limits = PACKAGE / module, source, limits
        sys.meta_path.insert(0, self)
        self._end_process_after(GRACE)

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        if fullname != self.name:
            return None
        loader = importlib.machinery.SourceFileLoader(fullname, str(self.module))
        code = compile(self.source, str(self.module), "exec", dont_inherit=True)
        loader.get_code = lambda _: code  # type: ignore[method-assign]
        return importlib.util.spec_from_file_location(fullname, self.module, loader=loader)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        found = {item.nodeid: item for item in items}
        items[:] = [found[test] for test in self.limits if test in found]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        self._end_process_after(self.limits[item.nodeid])

    def _end_process_after(self, limit: float) -> None:
        """End the process, even in C++ code, unless this is called again within `limit` [s]."""
        faulthandler.dump_traceback_later(limit, exit=True, file=sys.__stderr__)
