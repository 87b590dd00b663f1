"""Whole runs of the command, as a user starts them, each in a process of its own."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

MODELS = ("none", "radial", "refractive")


def measured_run(*arguments: str, out: Path | None = None) -> dict[str, Any]:
    """The metrics of `torchrefrac` with these arguments, its time `wall`, and `processor` of all its
    processes, in seconds, and its memory `peak` in GiB. out: where its results stay, if anywhere."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = out or Path(temporary)
        command = [sys.executable, "-m", "torchrefrac", *arguments, f"out={folder}"]
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        if status != 0:
            sys.exit(f"{' '.join(command)} ended with status {os.waitstatus_to_exitcode(status)}")
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    processor = usage.ru_utime + usage.ru_stime
    return metrics | {"wall": wall, "processor": processor, "peak": usage.ru_maxrss / 2**20}
