"""Sweeps in jobs of their own: of a Slurm cluster, or of this machine.

Not imported without hydra-submitit-launcher: Hydra loads no module whose name begins with an underscore by itself.
"""

import contextlib
import os
import shutil
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import submitit
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, env_override
from hydra.errors import HydraException
from hydra_plugins.hydra_submitit_launcher.config import BaseQueueConf
from hydra_plugins.hydra_submitit_launcher.submitit_launcher import BaseSubmititLauncher, LocalLauncher, SlurmLauncher
from omegaconf import OmegaConf
from submitit.core.utils import FailedSubmissionError, UncompletedJobError

from torchrefrac.sweeps.jobs import ending, find_job, record_of

LOST = "the job ended without a word: out of time, out of memory, or cancelled; its log is in"


class _Queue(BaseSubmititLauncher):
    """Waits for all jobs, whatever becomes of one; ends them when it is interrupted."""

    def executor(self) -> submitit.AutoExecutor:
        """Submits with the parameters of the configuration."""
        common = set(OmegaConf.structured(BaseQueueConf).keys()) - {"submitit_folder"}
        parameters = {key: value for key, value in self.params.items() if key not in ("submitit_folder", "at_once")}
        first = {f"{self._EXECUTOR}_max_num_timeout": parameters.pop("max_num_timeout", 0)}
        made = submitit.AutoExecutor(self.params["submitit_folder"], cluster=self._EXECUTOR, **first)
        made.update_parameters(
            **{key if key in common else f"{self._EXECUTOR}_{key}": value for key, value in parameters.items()}
        )
        return made

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Submit the jobs as one array and wait for them."""
        with self._environment():
            jobs = self._submit([list(overrides) for overrides in job_overrides], initial_job_idx)
        waiting = dict(enumerate(jobs))
        returned: dict[int, JobReturn] = {}
        try:
            for job in submitit.helpers.as_completed(jobs, poll_frequency=1.0):
                i = next(i for i, other in waiting.items() if other is job)
                del waiting[i]
                returned[i] = _result(job)
                self._print_end(job_overrides[i])
        except KeyboardInterrupt:
            for job in waiting.values():
                job.cancel(check=False)
            raise
        return [returned[i] for i in range(len(jobs))]

    def _submit(self, job_overrides: list[list[str]], first: int) -> list[Any]:
        numbers = range(first, first + len(job_overrides))
        names, states = [f"job_id_for_{i}" for i in numbers], [Singleton.get_state() for _ in numbers]
        keys = ["hydra.sweep.dir" for _ in numbers]
        try:
            return self.executor().map_array(self, job_overrides, keys, list(numbers), names, states)
        except FailedSubmissionError as error:
            raise HydraException(f"the jobs cannot be submitted: {error}") from None

    @contextlib.contextmanager
    def _environment(self) -> Generator[None, None, None]:
        yield

    def _print_end(self, overrides: Sequence[str]) -> None:
        """Print how a job ended, as its own output goes to a file."""
        assert self.config is not None
        sweep = Path(str(self.config.hydra.sweep.dir))
        name = overrides[-1].partition("=")[2].strip("'")
        place = find_job(sweep / name)
        if place is not None:
            print(ending(*place, record_of(place[2], sweep)), flush=True)


class SlurmQueue(_Queue, SlurmLauncher):
    """A job array of a Slurm cluster."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Raises HydraException where there is no Slurm."""
        if shutil.which("sbatch") is None or shutil.which("srun") is None:
            raise HydraException("hydra/launcher=slurm needs sbatch and srun, which are not found on this machine")
        return super().launch(job_overrides, initial_job_idx)


class LocalQueue(_Queue, LocalLauncher):
    """Processes of this machine, `at_once` of them at a time, which share its processors."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Submit as many as may run side by side, and the next when all of these have ended."""
        size, returned = max(1, self.params.get("at_once", 1)), []
        for start in range(0, len(job_overrides), size):
            returned += super().launch(job_overrides[start : start + size], initial_job_idx + start)
        return returned

    @contextlib.contextmanager
    def _environment(self) -> Generator[None, None, None]:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        threads = os.environ.get("OMP_NUM_THREADS", str(max(1, cores // max(1, self.params.get("at_once", 1)))))
        with env_override({"OMP_NUM_THREADS": threads}):
            yield


def _result(job: Any) -> JobReturn:
    try:
        return job.results()[0]
    except UncompletedJobError:
        lost = JobReturn(status=JobStatus.FAILED)
        lost.return_value = RuntimeError(f"{LOST} {job.paths.folder}")
        return lost
