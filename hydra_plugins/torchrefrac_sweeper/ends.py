"""What is told at the end of a sweep."""

import os
import shlex
import textwrap
from collections.abc import Sequence
from pathlib import Path

from hydra_plugins.torchrefrac_sweeper.jobs import Job, Outcome, outcome, read_sweep

WIDTH = 100


def unrecorded_lines(jobs: Sequence[Job], ends: Sequence[Outcome]) -> list[str]:
    """What the metrics of the jobs do not tell: those that failed and could not say so, and how many did not end."""
    pairs = list(zip(jobs, ends, strict=True))
    lost = [(job, end) for job, end in pairs if end.status == "failed" and end.metrics is None]
    stopped = sum(end.status not in ("failed", "complete") for end in ends)
    lines = [f"{len(lost)} of {len(jobs)} jobs failed and could not write so:"] if lost else []
    for job, end in lost:
        text = f"- {job.folder} ({job.label}): {end.reason}"
        lines.append(textwrap.fill(text, WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False))
    if stopped:
        lines.append(f"{stopped} of {len(jobs)} jobs did not come to an end")
    return lines


def resume_lines(folder: Path, arguments: Sequence[str]) -> list[str]:
    """How to run the rest of the sweep that the command line `arguments` began."""
    others = [text for text in arguments if not text.startswith("out=")]
    command = shlex.join(["torchrefrac", *others, f"out={os.path.relpath(folder)}"])
    return ["to run the rest, with the complete jobs kept:", f"  {command}"]


def jobs_and_ends(folder: Path) -> tuple[list[Job], list[Outcome]]:
    """What sweep.json and the folders of its jobs say; without one, every folder that holds metrics."""
    jobs = list(read_sweep(folder) or ())
    if not jobs:
        names = sorted((path.parent.name for path in folder.glob("*/metrics.json")), key=_number)
        jobs = [Job(name, (), name) for name in names]
    return jobs, [outcome(job, folder) for job in jobs]


def _number(name: str) -> tuple[int, str]:
    first = name.split("_", maxsplit=1)[0]
    return (int(first) if first.isdigit() else 10**9), name
