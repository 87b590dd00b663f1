"""The reports of the runs of a sweep, each beside those that differ from it in the model alone."""

from collections.abc import Sequence
from pathlib import Path

from torchrefrac.html.run_page import write_report
from torchrefrac.recorder import Recorder
from torchrefrac.sweeps.design import load_runs, shown_together, what_varied


def write_job_reports(runs: Sequence[Path], recorder: Recorder) -> None:
    """Write report.html into every run folder of a sweep. Raises OSError where one cannot be written."""
    jobs = load_runs(runs)
    groups = [[job.folder for job in members] for members in shown_together(jobs, what_varied(jobs)).values()]
    for run in recorder.track(runs, len(runs), "reports", "run"):
        beside = next((group for group in groups if run in group), [])
        write_report(run, [other for other in beside if other != run])
