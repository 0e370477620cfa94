"""Runs cells in a real Jupyter kernel, and interrupts them as the stop button does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jupyter_client.manager import start_new_kernel

ROOT = Path(__file__).resolve().parents[2]


class Kernel:
    """Runs cells.

    Attributes:
        client: Client of the kernel.
        manager: Manager that starts, interrupts and ends the kernel.
    """

    def __init__(self, manager: Any, client: Any) -> None:
        self.manager = manager
        self.client = client

    def run(
        self, code: str, *, interrupt: str | None = None, delay: float = 0.0, timeout: float = 120.0
    ) -> list[dict[str, Any]]:
        """Run a cell and return its outputs as in a saved notebook, with updates in place.

        Args:
            code: Code of the cell.
            interrupt: Text of an output that triggers an interrupt of the kernel.
            delay: Time between that output and the interrupt [s].
            timeout: Time limit of the cell [s].
        """
        sent = self.client.execute(code)
        outputs: list[dict[str, Any]] = []
        shown: dict[str, int] = {}
        end = time.monotonic() + timeout
        while True:
            message = self.client.get_iopub_msg(timeout=max(0.1, end - time.monotonic()))
            kind = message["msg_type"]
            content = message["content"]
            if message["parent_header"].get("msg_id") != sent:
                continue
            if kind == "status" and content["execution_state"] == "idle":
                return outputs
            if kind not in (
                "stream",
                "display_data",
                "update_display_data",
                "execute_result",
                "error",
            ):
                continue
            if kind == "update_display_data":
                outputs[shown[content["transient"]["display_id"]]].update(content, updates=True)
            else:
                display = content.get("transient", {}).get("display_id")
                if display is not None:
                    shown[display] = len(outputs)
                outputs.append({"kind": kind, **content})
            if interrupt is not None and interrupt in str(content):
                time.sleep(delay)
                self.manager.interrupt_kernel()
                interrupt = None


@contextmanager
def start_kernel() -> Iterator[Kernel]:
    """Start a kernel in which the package of this checkout is imported as `vkc`, and end it."""
    manager, client = start_new_kernel(kernel_name="python3", cwd=str(ROOT))
    try:
        started = Kernel(manager, client)
        started.run(
            f"import sys; sys.path[:0] = [{str(ROOT)!r}, {str(ROOT / 'tests')!r}]\nimport vkc_pin "
            "as vkc"
        )
        yield started
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
