"""Runs trials on a Dask cluster with a dashboard."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.request
from pathlib import Path

from distributed import LocalCluster

COMMAND = Path(sys.executable).with_name("vkc-pin")


def main() -> None:
    with LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0"
    ) as cluster:
        with urllib.request.urlopen(cluster.dashboard_link, timeout=60) as page:
            assert b"bokeh" in page.read().lower()
        options = ["--starts", "1", "--scenes", "init_1", "--methods", "auto"]
        options += ["--scheduler", cluster.scheduler_address, "--quiet"]
        out = Path("initialization").resolve()
        subprocess.run([COMMAND, "bench", "initialization", *options, "--out", out], check=True)
    # "auto", and step after step
    assert len(json.loads((out / "results.json").read_text(encoding="utf-8"))["trials"]) == 2


if __name__ == "__main__":
    main()
