"""A sweep that goes on when a job fails, and goes on from there when it is started again."""

import importlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from hydra_plugins.torchrefrac_sweeper.messages import COMPOSITION_ERRORS, one_sentence
from torchrefrac.files.run import RunRecord, RunStatus
from torchrefrac.sweeps.folder import SweepError, SweepFolder, unusable
from torchrefrac.sweeps.jobs import Job, by_name, ending, plan

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
        the sweep was reported with what there is.
        """
        config, context = self._context()
        combinations = self._combinations(arguments)
        folder, composed = self._compose(combinations)
        options = {name: found if isinstance(found, str) else _plain(found) for name, found in composed.items()}
        folder.require_same_settings(options)
        folder.save()
        try:
            OmegaConf.save(config, folder.path / "multirun.yaml")
        except OSError as error:
            raise SweepError(unusable(folder.path, error)) from None
        _print_kept(len(folder.complete), len(folder.jobs))
        self._defaults = str(config.model.name), str(OmegaConf.select(config, "scene.name"))
        try:
            for i, job in enumerate(folder.jobs):
                reason = composed[job.folder]
                if isinstance(reason, str):
                    folder.fail(job, reason, *self._defaults)
                    failed = RunRecord(folder.path / job.folder, RunStatus.FAILED, reason=reason)
                    print(ending(i + 1, len(folder.jobs), job, failed), file=sys.stderr)
            rest = [job for job in folder.jobs if job not in folder.complete and isinstance(options[job.folder], dict)]
            arguments_of = {job.folder: overrides for job, overrides in zip(folder.jobs, combinations, strict=True)}
            self._launch([job for job in rest if folder.make_ready(job)], arguments_of, folder)
        except KeyboardInterrupt:
            folder.save_failures()
            context.callbacks.on_multirun_end(config=config)
            raise
        folder.save_failures()
        return None

    def _context(self) -> tuple[DictConfig, HydraContext]:
        """What `setup` was given."""
        if self.config is None or self.hydra_context is None:
            raise RuntimeError("a sweeper sweeps after its setup")
        return self.config, self.hydra_context

    def _combinations(self, arguments: list[str]) -> list[tuple[str, ...]]:
        """The overrides of every job; those of the command line take the place of a preset's."""
        parser = OverridesParser.create(config_loader=self._context()[1].config_loader)
        given = parser.parse_overrides([*self._parse_config(), *arguments])
        for override in given:
            if override.key_or_group in ONE_VALUE and override.is_sweep_override():
                raise SweepError(
                    f"{override.input_line} has several values, but a sweep has one {override.key_or_group}"
                )
        return list(dict.fromkeys(tuple(job) for batch in self.split_arguments(given, None) for job in batch))

    def _place(self, combinations: Sequence[Sequence[str]]) -> Path:
        """Where the sweep lies; all jobs get the same, however their own configuration would call it."""
        config, _ = self._context()
        scenes = {by_name(job).get("scene") for job in combinations}
        scene = "scenes" if len(scenes) > 1 else scenes.pop()
        if scene is not None:
            with open_dict(config):
                config.scene.name = scene
        given = str(OmegaConf.select(config, "hydra.sweep.dir"))
        if not given.strip():
            raise SweepError("out is empty, but must be the folder for the results")
        folder = Path(given)
        config.hydra.sweep.dir = str(folder)
        return folder

    def _compose(self, combinations: Sequence[Sequence[str]]) -> tuple[SweepFolder, dict[str, DictConfig | str]]:
        """The jobs, and by their folders the configuration of each, or why it cannot be composed."""
        config, context = self._context()
        place = self._place(combinations)
        composed: list[DictConfig | str] = []
        for overrides in combinations:
            try:
                composed.append(context.config_loader.load_sweep_config(config, list(overrides)))
            except (*COMPOSITION_ERRORS, ValueError) as error:
                composed.append(one_sentence(error))
        if len(set(map(str, composed))) == 1 and isinstance(composed[0], str):
            raise SweepError(composed[0])
        default = str(OmegaConf.select(config, "model.name"))
        models = [
            by_name(overrides).get("model", default) if isinstance(found, str) else str(found.model.name)
            for overrides, found in zip(combinations, composed, strict=True)
        ]
        folder = SweepFolder(place, plan(combinations, models))
        return folder, dict(zip((job.folder for job in folder.jobs), composed, strict=True))

    def _launch(self, jobs: Sequence[Job], arguments_of: Mapping[str, Sequence[str]], folder: SweepFolder) -> None:
        """All jobs; those that an engine lost are tried again one by one, so that only what is at fault fails."""
        one_by_one = isinstance(self.launcher, BasicLauncher)
        size = 1 if one_by_one else self.max_batch_size or max(1, len(jobs))
        for start in range(0, len(jobs), size):
            batch = jobs[start : start + size]
            if not self._try(batch, arguments_of, folder) and len(batch) > 1:
                for job in batch:
                    if not folder.has_record(job):
                        self._try([job], arguments_of, folder)

    def _try(self, batch: Sequence[Job], arguments_of: Mapping[str, Sequence[str]], folder: SweepFolder) -> bool:
        """Whether the launcher came back; why jobs without a record failed is recorded."""
        if self.launcher is None:
            raise RuntimeError("a sweeper sweeps after its setup")
        where = f"hydra.sweep.dir={_quoted(str(folder.path))}"
        overrides = [[*arguments_of[job.folder], where, f"hydra.sweep.subdir={_quoted(job.folder)}"] for job in batch]
        number = int(batch[0].folder.split("_")[0])
        try:
            returned: Sequence[JobReturn] = self.launcher.launch(overrides, initial_job_idx=number)
        except (OSError, BrokenExecutor, MemoryError) as error:
            if len(batch) == 1:
                reason = one_sentence(error, folder.path / batch[0].folder)
                folder.fail(batch[0], reason, *self._defaults)
            return False
        for job, result in zip(batch, returned, strict=True):
            if result.status is not JobStatus.COMPLETED and not folder.has_record(job):
                error = result._return_value  # pyright: ignore[reportPrivateUsage]
                folder.fail(job, one_sentence(error), *self._defaults)
        return True


def _plain(config: DictConfig) -> dict[str, Any]:
    """The options of a job, but for where its results go, as they stand in the file that a run leaves."""
    keys = [str(key) for key in config if key not in ("hydra", "out")]
    return yaml.safe_load(OmegaConf.to_yaml(OmegaConf.masked_copy(config, keys)))


def _print_kept(kept: int, total: int) -> None:
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
