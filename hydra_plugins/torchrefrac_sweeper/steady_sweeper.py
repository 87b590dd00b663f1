"""A sweep that goes on when a job fails, and goes on from there when it is started again."""

import importlib
import importlib.util
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from hydra_plugins.torchrefrac_sweeper.jobs import (
    Job,
    Outcome,
    ending,
    outcome,
    plan,
    spread,
    write_sweep,
)
from hydra_plugins.torchrefrac_sweeper.messages import COMPOSITION_ERRORS, one_sentence
from hydra_plugins.torchrefrac_sweeper.previous import SweepError, in_folder, require_same_settings, unusable
from hydra_plugins.torchrefrac_sweeper.records import has_ended, write_failure

QUEUES = "hydra_plugins.torchrefrac_sweeper._queues"
ONE_VALUE = ("out", "sweep")


class SteadySweeper(BasicSweeper):
    """Runs every combination of the values that are given, in folders NUMBER_MODEL of the sweep's folder.

    A job that cannot be composed, that raises or that dies leaves a metrics.json that says so, and the others run. When
    the same is started again with the same folder, complete jobs are kept and the others run. Jobs that would now be
    composed differently from the complete ones (a default has changed) are refused rather than mixed with them, and so
    is a folder that holds anything else: nothing complete is ever overwritten.
    """

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Raises SweepError where the launcher is not installed."""
        target = str(OmegaConf.select(config, "hydra.launcher._target_"))
        needs = "hydra_plugins.hydra_submitit_launcher" if target.startswith(QUEUES) else target.rpartition(".")[0]
        if _is_missing(needs):
            launcher = config.hydra.runtime.choices.get("hydra/launcher")
            raise SweepError(f"hydra/launcher={launcher} needs more packages: pip install 'torchrefrac[sweep]'")
        if target.startswith(QUEUES):  # Hydra has not found them itself, as they need these packages
            Plugins.instance().register(getattr(importlib.import_module(QUEUES), target.rpartition(".")[2]))
        super().setup(hydra_context=hydra_context, task_function=task_function, config=config)

    def sweep(self, arguments: list[str]) -> Any:
        """Run the jobs that are not complete.

        Raises SweepError when none can be run or the folder holds something else, KeyboardInterrupt after the end of
        the sweep was told of what there is.
        """
        assert self.config is not None
        assert self.hydra_context is not None
        combinations = self._combinations(arguments)
        folder = self._folder(combinations)
        jobs, reasons, configs = self._plan(combinations, folder)
        kept = [job for job in jobs if outcome(job, folder).status == "complete"]
        require_same_settings(kept, configs, reasons, folder)
        self._save(jobs, folder)
        _tell_kept(len(kept), len(jobs))
        self._scene = str(OmegaConf.select(self.config, "scene.name"))
        self._lost: dict[str, str] = {}
        try:
            for i, job in enumerate(jobs):
                if job.folder in reasons:
                    self._fail(job, folder, reasons[job.folder])
                    print(ending(i + 1, len(jobs), job, Outcome("failed", reasons[job.folder])), file=sys.stderr)
            todo = [job for job in jobs if job not in kept and job.folder not in reasons]
            arguments_of = {job.folder: overrides for job, overrides in zip(jobs, combinations, strict=True)}
            self._launch([job for job in todo if self._is_ready(job, folder)], arguments_of, folder)
        except KeyboardInterrupt:
            self._save_lost(jobs, folder)
            self.hydra_context.callbacks.on_multirun_end(config=self.config)
            raise
        self._save_lost(jobs, folder)
        return None

    def _combinations(self, arguments: list[str]) -> list[tuple[str, ...]]:
        """The overrides of every job; those of the command line take the place of a preset's."""
        assert self.hydra_context is not None
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        given = parser.parse_overrides([*self._parse_config(), *arguments])
        for override in given:
            if override.key_or_group in ONE_VALUE and override.is_sweep_override():
                raise SweepError(
                    f"{override.input_line} has several values, but a sweep has one {override.key_or_group}"
                )
        return list(dict.fromkeys(tuple(job) for batch in self.split_arguments(given, None) for job in batch))

    def _folder(self, combinations: Sequence[Sequence[str]]) -> Path:
        """Where the sweep lies; all jobs get the same, however their own configuration would call it."""
        assert self.config is not None
        every = [spread(job) for job in combinations]
        if len({job.get("scene") for job in every}) > 1:
            with open_dict(self.config):
                self.config.scene.name = "scenes"
        elif "scene" in every[0]:
            with open_dict(self.config):
                self.config.scene.name = every[0]["scene"]
        folder = Path(str(OmegaConf.select(self.config, "hydra.sweep.dir")))
        self.config.hydra.sweep.dir = str(folder)
        return folder

    def _plan(
        self, combinations: Sequence[Sequence[str]], folder: Path
    ) -> tuple[tuple[Job, ...], dict[str, str], dict[str, DictConfig]]:
        """The jobs, why some cannot be composed, and the configurations of the others, by folder."""
        assert self.config is not None
        assert self.hydra_context is not None
        composed: list[DictConfig | str] = []
        for overrides in combinations:
            try:
                composed.append(self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides)))
            except (*COMPOSITION_ERRORS, ValueError) as error:
                composed.append(one_sentence(error))
        if len(set(map(str, composed))) == 1 and isinstance(composed[0], str):
            raise SweepError(composed[0])
        default = str(OmegaConf.select(self.config, "model.name"))
        models = [
            spread(overrides).get("model", default) if isinstance(found, str) else str(found.model.name)
            for overrides, found in zip(combinations, composed, strict=True)
        ]
        jobs = in_folder(plan(combinations, models), folder)
        pairs = list(zip((job.folder for job in jobs), composed, strict=True))
        reasons = {name: found for name, found in pairs if isinstance(found, str)}
        return jobs, reasons, {name: found for name, found in pairs if not isinstance(found, str)}

    def _save(self, jobs: Sequence[Job], folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_sweep(jobs, folder)
            OmegaConf.save(self.config, folder / "multirun.yaml")
        except OSError as error:
            raise SweepError(unusable(folder, error)) from None

    def _is_ready(self, job: Job, folder: Path) -> bool:
        """Make the job's folder, without what an earlier attempt said of its end."""
        run = folder / job.folder
        try:
            run.mkdir(parents=True, exist_ok=True)
            (run / "metrics.json").unlink(missing_ok=True)
            with tempfile.TemporaryFile(dir=run):
                return True
        except OSError as error:
            self._lost[job.folder] = unusable(run, error)
            return False

    def _launch(self, jobs: Sequence[Job], arguments_of: Mapping[str, Sequence[str]], folder: Path) -> None:
        """All jobs; those that an engine lost are tried again one by one, so that only what is at fault fails."""
        one_by_one = isinstance(self.launcher, BasicLauncher)
        size = 1 if one_by_one else self.max_batch_size or max(1, len(jobs))
        for start in range(0, len(jobs), size):
            batch = jobs[start : start + size]
            if not self._try(batch, arguments_of, folder) and len(batch) > 1:
                for job in batch:
                    if not has_ended(folder / job.folder):
                        self._try([job], arguments_of, folder)

    def _try(self, batch: Sequence[Job], arguments_of: Mapping[str, Sequence[str]], folder: Path) -> bool:
        """Whether the launcher came back; what it says of jobs that left no word is kept."""
        assert self.launcher is not None
        overrides = [
            [
                *arguments_of[job.folder],
                f"hydra.sweep.dir={_quoted(str(folder))}",
                f"hydra.sweep.subdir={_quoted(job.folder)}",
            ]
            for job in batch
        ]
        number = int(batch[0].folder.split("_")[0])
        try:
            returned: Sequence[JobReturn] = self.launcher.launch(overrides, initial_job_idx=number)
        except (OSError, BrokenExecutor, MemoryError) as error:
            if len(batch) == 1:
                self._fail(batch[0], folder, one_sentence(error, folder / batch[0].folder))
            return False
        for job, result in zip(batch, returned, strict=True):
            if result.status is not JobStatus.COMPLETED and not has_ended(folder / job.folder):
                self._fail(job, folder, one_sentence(result._return_value))
        return True

    def _fail(self, job: Job, folder: Path, reason: str) -> None:
        """Record a failure that the job could not record itself."""
        values = spread(job.overrides)
        assert self.config is not None
        model, scene = values.get("model", str(self.config.model.name)), values.get("scene", self._scene)
        try:
            write_failure(folder / job.folder, reason, model, scene, job.overrides)
        except OSError:
            self._lost[job.folder] = reason

    def _save_lost(self, jobs: Sequence[Job], folder: Path) -> None:
        """Let sweep.json say what the folders of the jobs cannot."""
        if self._lost:
            self._save([replace(job, reason=self._lost.get(job.folder, "")) for job in jobs], folder)


def _tell_kept(kept: int, total: int) -> None:
    if kept:
        jobs = "job" if total == 1 else "jobs"
        was, are = ("was", "is") if kept == 1 else ("were", "are")
        print(f"{kept} of {total} {jobs} {was} finished before and {are} kept")


def _is_missing(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is None
    except ModuleNotFoundError:
        return True


def _quoted(text: str) -> str:
    """A string of Hydra's grammar."""
    return "'" + text.replace("\\'", "\\\\'").replace("'", "\\'") + "'"
