"""Errors in length units, which are in the names of the metrics and may differ between scenes."""

from collections.abc import Iterable, Sequence

from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.markdown import decimals


def unit_of(jobs: Iterable[RunRecord], stem: str) -> str:
    """The length unit that ends the names of the metric `stem`_UNIT; empty where no job has it."""
    names = (name for job in jobs for name in job.metrics)
    return next((unit for name in names if (unit := _unit_after(name, stem))), "")


def in_header(title: str, jobs: Sequence[RunRecord], stem: str) -> str:
    """A column's title, with the unit where that is the same for all jobs."""
    units = _units(jobs, stem)
    return f"{title} ({units.pop()})" if len(units) == 1 else title


def error_text(job: RunRecord, jobs: Sequence[RunRecord], stem: str) -> str:
    """What a job has of the metric `stem`_UNIT, with the unit where the header of all `jobs` cannot name it."""
    unit = unit_of([job], stem)
    value = job.number(f"{stem}_{unit}")
    return decimals(value) + (f" {unit}" if value is not None and len(_units(jobs, stem)) > 1 else "")


def rounded(job: RunRecord, name: str, places: int = 0) -> str:
    """A metric with so many places; a dash where the job has none."""
    value = job.number(name)
    return "-" if value is None else f"{value:.{places}f}"


def registered(job: RunRecord) -> str:
    """How many images are registered, of how many."""
    return f"{rounded(job, 'registered_images')}/{rounded(job, 'images')}"


def _units(jobs: Sequence[RunRecord], stem: str) -> set[str]:
    return {unit_of([job], stem) for job in jobs} - {""}


def _unit_after(name: str, stem: str) -> str:
    """What follows `stem`_ in a metric's name where that is one word, a unit; else empty."""
    rest = name.removeprefix(f"{stem}_")
    return rest if rest != name and "_" not in rest else ""
