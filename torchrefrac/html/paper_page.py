"""The page paper.html: the paper's Table 1 and Figures 1, 3, 5 and 6 (Chang & Chen, ICCV 2011) beside those of runs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrefrac.figures.plotting import save
from torchrefrac.files.run import RunRecord
from torchrefrac.html.contents import RunContents, read_contents
from torchrefrac.html.drawn import Drawn
from torchrefrac.html.page import png, write_page
from torchrefrac.html.paper_figures import of_photographed, of_synthetic
from torchrefrac.html.paper_numbers import (
    PHOTOGRAPHED,
    SYNTHETIC,
    Records,
    explained,
    table_beside_paper,
    table_of,
    verdict,
)
from torchrefrac.html.tables import Cell
from torchrefrac.html.words import model_title, models_words
from torchrefrac.scene import Truth
from torchrefrac.sweeps.design import load_runs

PAGE = "paper.html"
IN_FIGURES = ("none", "radial", "refractive")
"""The models that the paper compares, in the order of its Table 1."""
FORMATS: dict[str, dict[str, Any]] = {"png": {}, "pdf": {"metadata": {"CreationDate": None}}}
"""In which figures are written, and how: the same figure always gives the same file."""


@dataclass(frozen=True)
class Figure:
    """A figure in the page, and the links to it in files of its own."""

    drawn: Drawn
    files: tuple[Cell, ...]


def write_paper(folder: Path, runs: Sequence[Path]) -> Path:
    """Write `folder`/paper.html and its figures, paper_figure1.png and .pdf and so on, of complete runs; returns the
    page's path.

    Of each scene and model the first of the run folders `runs` counts. What needs runs that are not there is left out,
    and the page says so. Links are to reports that must be written before. Raises OSError where a file cannot be
    written.
    """
    records: dict[tuple[str, str], RunRecord] = {}
    for record in load_runs(runs):
        if record.is_complete:
            records.setdefault((record.scene, record.model), record)
    truths: dict[Path, Truth | None] = {}
    made = (
        *of_synthetic(_contents(records, SYNTHETIC, truths)),
        *of_photographed(_contents(records, PHOTOGRAPHED, truths)),
    )
    write_page(
        "paper.html",
        folder / PAGE,
        title="The paper's experiments, made again",
        verdict=verdict(records),
        models=models_words(list(records.values())),
        table=table_beside_paper(records, folder),
        others=table_of(records, PHOTOGRAPHED, folder),
        explained=explained(records),
        figures=[
            Figure(Drawn(title, png(figure), alt, caption, look), tuple(_saved(figure, folder, stem)))
            for stem, figure, title, alt, caption, look in made
        ],
        missing=[
            f"{scene}, {model_title(model)}"
            for scene in (SYNTHETIC, PHOTOGRAPHED)
            for model in IN_FIGURES
            if (scene, model) not in records
        ],
    )
    return folder / PAGE


def _contents(records: Records, scene: str, truths: dict[Path, Truth | None]) -> dict[str, RunContents]:
    """The runs of a scene that the figures show, by their models."""
    chosen = {model: records[scene, model].folder for model in IN_FIGURES if (scene, model) in records}
    read = {model: read_contents(run, truths) for model, run in chosen.items()}
    return {model: run for model, run in read.items() if run.scene is not None}


def _saved(figure: Any, folder: Path, stem: str) -> Iterator[Cell]:
    for kind, how in FORMATS.items():
        save(figure, folder / f"{stem}.{kind}", **how)
        yield Cell(kind.upper(), f"{stem}.{kind}")
