"""What is printed at the end of a sweep beside its summary."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from torchrefrac.files.run import RunRecord, RunStatus
from torchrefrac.record.terminal import wrapped
from torchrefrac.sweeps.jobs import Job


def unrecorded_lines(jobs: Sequence[Job], records: Sequence[RunRecord]) -> list[str]:
    """What no metrics.json says: which jobs failed and could not write so, and how many did not end."""
    failed = RunStatus.FAILED
    lost = [(job, end) for job, end in zip(jobs, records, strict=True) if end.status is failed and not end.metrics]
    stopped = sum(end.status is not failed and not end.is_complete for end in records)
    lines = [f"{len(lost)} of {len(jobs)} jobs failed and could not write so:"] if lost else []
    lines += [wrapped(f"- {job.folder} ({job.label}): {end.reason}") for job, end in lost]
    return lines + ([f"{stopped} of {len(jobs)} jobs did not come to an end"] if stopped else [])


def resume_lines(folder: Path, arguments: Sequence[str]) -> list[str]:
    """How to run the rest of the sweep that the command line `arguments` began."""
    others = [text for text in arguments if not text.startswith("out=")]
    command = shlex.join(["torchrefrac", *others, f"out={os.path.relpath(folder)}"])
    return ["to run the rest, with the complete jobs kept:", f"  {command}"]
