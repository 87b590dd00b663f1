"""What the folder of a sweep holds from before, and whether that may be kept."""

from collections.abc import Sequence
from pathlib import Path

from hydra.errors import HydraException
from omegaconf import DictConfig

from hydra_plugins.torchrefrac_sweeper.jobs import Job, read_sweep, remembered
from hydra_plugins.torchrefrac_sweeper.settings import difference


class SweepError(HydraException):
    """No job of the sweep can be run; the message says why."""


def in_folder(jobs: tuple[Job, ...], folder: Path) -> tuple[Job, ...]:
    """The jobs with the folders that they had before. Raises SweepError where `folder` holds something else."""
    try:
        known = read_sweep(folder)
    except ValueError as error:
        raise SweepError(str(error)) from None
    if known is None:
        if (folder / "metrics.json").exists() or any(folder.glob("*/metrics.json")):
            raise SweepError(f"{folder} holds results that are not of this sweep; give another folder as out=DIR")
        return jobs
    same = remembered(jobs, known)
    if same is None:
        example = next((job.label for job in known if job.overrides not in {j.overrides for j in jobs}), known[0].label)
        raise SweepError(
            f"{folder} holds another sweep ({len(known)} jobs, one of them {example}); give another folder as out=DIR"
        )
    return same


def require_same_settings(
    kept: Sequence[Job], configs: dict[str, DictConfig], reasons: dict[str, str], folder: Path
) -> None:
    """Raise SweepError where a complete job was made with other settings than it would be now."""
    for job in kept:
        found = reasons.get(job.folder) or difference(folder / job.folder, configs[job.folder])
        if found:
            raise SweepError(
                f"{folder / job.folder} was made with other settings ({found}); delete it to have it made again, or "
                "give another folder as out=DIR"
            )


def unusable(folder: Path, error: OSError) -> str:
    """The sentence for a folder that results cannot go to."""
    said = error.strerror or type(error).__name__
    return f"{folder} cannot be written to ({said}); make it a folder that can, or give another as out=DIR"
