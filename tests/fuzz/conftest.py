"""Limits the memory of the process, and keeps temporary files together, while cases run."""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ADDRESS_SPACE = 6 * 2**30  # [bytes] that cases may add, so that excessive allocations fail at once


@pytest.fixture(scope="module", autouse=True)
def limited_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Limit memory and the time of reading a file; move temporary files to pytest's folder."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + ADDRESS_SPACE
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("temporary")))
        patch.setenv("MPLBACKEND", "agg")
        patch.setenv("VKC_PIN_PARSE_SECONDS", "10")
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
        yield
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
