"""Shows the progress of planning in one line of a notebook or terminal."""

from __future__ import annotations

import contextlib
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TextIO

from vkc_pin.errors import InputError
from vkc_pin.errors import format_value as told
from vkc_pin.utils.notebook import in_notebook

if TYPE_CHECKING:
    from vkc_pin.planning.plan import Plan
    from vkc_pin.planning.solver.solution import Iteration


class Progress:
    """The progress line; `write` shows a text, and whether it is the last. Default: no line."""

    def __init__(self, write: Callable[[str, bool], None] | None = None) -> None:
        self.write = write
        self._part = self._what = self._doing = ""
        self._began = time.perf_counter()
        self._ended = write is None

    def set_steps(self, first: int, count: int, total: int) -> None:
        """Set the next steps: `count` from number `first`, counted from 1, of `total`."""
        self._part = (
            f"step {first} of {total}"
            if count == 1
            else f"steps {first} to {first + count - 1} of {total}"
        )

    def begin(self, phases: Sequence[str]) -> None:
        """Set the phases of the next trajectory."""
        self._what = ", ".join(phases)
        self.set_activity("preparing")

    def set_activity(self, text: str) -> None:
        """Show the current activity."""
        self._doing = text
        self._show()

    def __call__(self, row: Iteration) -> None:
        """Show a round of the solver."""
        missing = "clear" if row.shortfall <= 0.0 else f"{1e3 * row.shortfall:.1f} mm missing"
        self._doing = f"round {row.round}, {missing}, objective {row.objective:.3g}"
        self._show()

    def end(self, plan: Plan) -> None:
        """Show the result."""
        m, name = plan.metrics, plan.scene.name
        result = "success" if plan.success else f"FAILED, {plan.status}"
        lengths = f"base {m['base_path_length']:.2f} m, arm {m['arm_path_length']:.2f} rad"
        self._last(f"{name}: {result} — {lengths}, planned in {m['planning_time']:.2f} s")

    def stop(self) -> None:
        """Show that planning has stopped, unless the result is shown."""
        self._last(f"stopped after {time.perf_counter() - self._began:.1f} s")

    def _show(self) -> None:
        if not self._ended and self.write is not None:
            passed = f"{time.perf_counter() - self._began:.0f} s"
            self._write(
                " · ".join(filter(None, [passed, self._part, self._doing, self._what])), False
            )

    def _last(self, text: str) -> None:
        if not self._ended and self.write is not None:
            self._ended = True
            self._write(text, True)

    def _write(self, text: str, last: bool) -> None:
        with contextlib.suppress(OSError, ValueError):
            if self.write is not None:
                self.write(text, last)


@contextlib.contextmanager
def show_progress(progress: object) -> Iterator[Progress]:
    """Yield the progress line, and finish it in any case.

    With `progress` it is shown in a notebook's cell, or in a terminal on standard error; elsewhere,
    as in a pipe, nothing is shown. Raises `InputError` if `progress` is neither True nor False.
    """
    if not isinstance(progress, bool):
        raise InputError(
            "wrong type of argument", field="progress", expected="True or False", got=told(progress)
        )
    line = Progress(_screen() if progress else None)
    try:
        yield line
    finally:
        line.stop()


def _screen() -> Callable[[str, bool], None] | None:
    """Return the function that shows a line, or None without terminal and notebook."""
    if in_notebook():
        return _Line(sys.stdout, None)
    if sys.stderr is not None and sys.stderr.isatty():
        # A longer line would go over two lines, and stay.
        width = shutil.get_terminal_size().columns - 1
        return _Line(sys.stderr, width)
    return None


class _Line:
    """A bar of tqdm with text only."""

    def __init__(self, stream: TextIO, width: int | None) -> None:
        self.stream, self.width = stream, width
        self.bar: Any = None

    def __call__(self, text: str, last: bool) -> None:
        if self.bar is None:
            # Not tqdm.auto, which has no words in a notebook without ipywidgets but a warning.
            from tqdm import tqdm

            # Asked for its size, a terminal that has none, as some do, would be shown nothing.
            self.bar = tqdm(file=self.stream, bar_format="{desc}", ncols=self.width or 80, nrows=20)
        self.bar.set_description_str(text[: self.width])
        if last:
            self.bar.close()
