"""Tables in Markdown that read well in a terminal too, and their cells.

Errors have length units, which are in the names of the metrics and may differ between scenes.
"""

from collections.abc import Iterable, Sequence

from torchrefrac.files.run import RunRecord


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The cells in columns of equal width; a bar within a cell is escaped, a line break is a space."""
    header, *rows = [[_escaped(cell) for cell in row] for row in (header, *rows)]
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = [_line(header, widths), "|" + "|".join("-" * (w + 2) for w in widths) + "|"]
    return "\n".join(lines + [_line(row, widths) for row in rows])


def decimals(value: float | None) -> str:
    """Four places; of less than that only the order of magnitude, of nothing a dash."""
    if value is None:
        return "-"
    return f"{value:.4f}" if value == 0.0 or abs(value) >= 0.001 else f"{value:.1e}"


def unit_of(jobs: Iterable[RunRecord], stem: str) -> str:
    """The length unit, one word, that ends the names of the metric `stem`_UNIT; empty where no job has it."""
    start = f"{stem}_"
    rests = (name.removeprefix(start) for job in jobs for name in job.metrics if name.startswith(start))
    return next((rest for rest in rests if rest and "_" not in rest), "")


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


def _escaped(cell: str) -> str:
    return " ".join(cell.splitlines()).replace("|", "\\|")


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
