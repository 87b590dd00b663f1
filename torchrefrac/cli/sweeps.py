"""What is printed and written while a sweep runs, and when it has ended."""

import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import torch
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from torchrefrac.cli.arguments import typed
from torchrefrac.cli.commands import is_watched
from torchrefrac.cli.failures import failed, keep_failure, tell
from torchrefrac.files.run import RunRecord, RunStatus
from torchrefrac.html import write_job_reports, write_paper, write_sweep_report
from torchrefrac.record.terminal import TerminalRecorder, wrapped
from torchrefrac.recorder import SilentRecorder
from torchrefrac.sweeps.comparison import compare
from torchrefrac.sweeps.jobs import Job, ending, find_job, jobs_and_records, opening, record_of
from torchrefrac.sweeps.summary import write_summary


class CompareRuns(Callback):
    """Follows a multirun, whatever it runs over, and compares its runs at the end.

    The paper's Table 1 and Figure 1, also of dense surfaces, a summary of what was varied, and reports; with `paper`
    also the page that sets the paper's numbers and figures beside those of the runs.
    """

    def __init__(self, paper: bool = False) -> None:
        self._paper = paper

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Say which job begins, or, where several run side by side, share the processors."""
        if config.hydra.mode is not RunMode.MULTIRUN:
            return
        place = find_job(Path(config.hydra.runtime.output_dir))
        if not is_watched(config.hydra):
            _share_processors()
        elif place is not None and not config.quiet:
            print(f"\n{opening(*place)}", file=sys.stderr)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Record why a job failed, and print it."""
        if config.hydra.mode is not RunMode.MULTIRUN:
            return
        folder = Path(config.hydra.runtime.output_dir)
        if job_return.status is JobStatus.FAILED:
            reason = keep_failure(job_return._return_value, config, list(config.hydra.overrides.task), folder)
            job_return.return_value = RuntimeError(reason)  # goes to the sweeper, maybe in another process
            if is_watched(config.hydra):
                print(f"error: {reason}", file=sys.stderr)
        place = find_job(folder)
        if place is not None and not is_watched(config.hydra) and not config.quiet:
            print(ending(*place, record_of(place[2], folder.parent)), flush=True)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print what failed, write and print the comparison, and print how to go on."""
        folder = Path(config.hydra.sweep.dir)
        jobs, records = jobs_and_records(folder)
        rest = sum(not record.is_complete for record in records)
        if rest:
            failed.append(f"{rest} of {len(jobs)} jobs are not complete")
        runs = [record.folder for record in records if record.metrics]
        told = ["\n".join(_unrecorded(jobs, records))]
        if runs:
            try:
                told += _write(folder, runs, config, self._paper)
            except OSError as error:
                tell(error, folder)
        if rest:
            others = [text for text in typed if not text.startswith("out=")]
            command = shlex.join(["torchrefrac", *others, f"out={os.path.relpath(folder)}"])
            told.append(f"to run the rest, with the complete jobs kept:\n  {command}")
        if rest or not config.quiet:
            print("", *filter(None, told), sep="\n\n")


def _unrecorded(jobs: Sequence[Job], records: Sequence[RunRecord]) -> list[str]:
    """What no metrics.json says: which jobs failed and could not write so, and how many did not end."""
    ended = list(zip(jobs, records, strict=True))
    lost = [(job, end) for job, end in ended if end.status is RunStatus.FAILED and not end.metrics]
    stopped = sum(end.status is not RunStatus.FAILED and not end.is_complete for end in records)
    lines = [f"{len(lost)} of {len(jobs)} jobs failed and could not write so:"] if lost else []
    lines += [wrapped(f"- {job.folder} ({job.label}): {end.reason}") for job, end in lost]
    return lines + ([f"{stopped} of {len(jobs)} jobs did not come to an end"] if stopped else [])


def _write(folder: Path, runs: list[Path], config: DictConfig, paper: bool) -> list[str]:
    """Everything that compares the runs; returns what to print of it."""
    table = compare(runs, folder)
    if config.report:
        write_job_reports(runs, SilentRecorder() if config.quiet else TerminalRecorder())
    if paper:
        write_paper(folder, runs)
    said = write_summary(folder, runs, to_come=("report.html",) if config.report else ())
    if config.report:
        write_sweep_report(folder, runs)
    shown = (table or said.table) if said.table else ""  # without a complete job there is nothing to compare
    return [said.failed, shown, f"the tables and figures are in {os.path.relpath(folder)}"]


def _share_processors() -> None:
    """Take no more threads than the job was given in OMP_NUM_THREADS, also in what does not read it."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdigit() and int(given) > 0:
        torch.set_num_threads(int(given))
    cv2.setNumThreads(torch.get_num_threads())
