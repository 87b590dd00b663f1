"""Long work in many parts, done by processes of this machine or by the workers of a Dask cluster.

What schedules is the standard library, or Dask. Here is only what neither does: processes begin when there is enough
to do, end when this one is killed, and are begun again, without loss, where one of them was.
"""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from types import TracebackType
from typing import Literal, Self, TypeVar

import torch

from torchrefrac.errors import TorchrefracError

S = TypeVar("S")
T = TypeVar("T")
WORTH_S = 10.0
"""Time of one processor, below which processes are not worth beginning: each takes a second or two to load what it
needs."""
QUEUED = 3
"""Parts for each worker that it has, or that wait for it."""
LOSSES = 3
"""How often in a row processes are begun again that end before any part of the work is done."""
PATIENCE_S = 30.0
"""How long a Dask scheduler may take to answer."""


class ExecutorError(TorchrefracError, RuntimeError):
    """Workers cannot be reached, or end again and again; the message says what would help."""


@dataclass(frozen=True)
class ExecutorOptions:
    """Where work in many parts is done: by "processes" of this machine, or by the workers of the "dask" scheduler at
    `address` (such as tcp://host:8786), which need this package and see the photographs under the same paths.

    workers: how many processes, 0: as many as PyTorch has threads (see OMP_NUM_THREADS), 1: none beside this one.

    Raises ValueError for a scheduler without an address, or an address without one.
    """

    kind: Literal["processes", "dask"] = "processes"
    workers: int = 0
    address: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.workers <= 1024:
            raise ValueError(f"workers is {self.workers}, but must lie between 0 and 1024")
        if (self.kind == "dask") != (self.address is not None):
            wanted = "must be that of a scheduler" if self.kind == "dask" else "is for executor=dask alone"
            raise ValueError(f"address is {self.address!r}, but {wanted}")


class Workers:
    """Does work in many parts as its options say; in a `with` block, which ends processes and connections."""

    def __init__(self, options: ExecutorOptions | None = None) -> None:
        self.options = options or ExecutorOptions(workers=1)
        self._executor: Executor | None = None
        self._capacity = 1
        self._close: Callable[[], object] = lambda: None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End processes and connections; there will be new ones where more is to be done."""
        close, self._executor, self._close = self._close, None, lambda: None
        close()

    @property
    def count(self) -> int:
        """How many processes there may be on this machine."""
        return self.options.workers or torch.get_num_threads()

    def each(self, function: Callable[[S], T], jobs: Sequence[S], seconds: float) -> Iterator[tuple[int, T]]:
        """The number of each job and what `function` makes of it, as they are done; both must be such as can be
        pickled. seconds: about how long one takes; where all together are not worth beginning processes for, or there
        is to be one alone, they are done in this one, one after the other.

        An error in a part is raised here. Raises ExecutorError where workers end again and again.
        """
        here = self.count == 1 or len(jobs) < 2 or len(jobs) * seconds < WORTH_S
        if self.options.kind == "processes" and here:
            yield from ((number, function(job)) for number, job in enumerate(jobs))
            return
        left, losses = dict(enumerate(jobs)), 0
        while left:
            try:
                for number, done in self._submitted(function, left):
                    yield number, done
                    del left[number]
                    losses = 0
            except BrokenProcessPool:
                self.close()
                losses += 1
                if losses > LOSSES:
                    raise self._lost() from None
            except BaseException:
                self.close()
                raise

    def together(self, work: Callable[[Executor | None], T], worth: bool) -> T:
        """What `work` returns that hands out its parts by itself, with an executor, or None where processes are not
        worth beginning, or there is to be one alone. Done once more, with new processes, where one was lost: what it
        has stored it need not do again.

        Raises ExecutorError where workers end again and again.
        """
        if self.options.kind == "processes" and (self.count == 1 or not worth):
            return work(None)
        for _ in range(LOSSES):
            with suppress(BrokenProcessPool):
                return work(self._open())
            self.close()
        raise self._lost()

    def _submitted(self, function: Callable[[S], T], jobs: dict[int, S]) -> Iterator[tuple[int, T]]:
        """As many at once as keep all workers busy: what waits takes memory, that of a scheduler too."""
        executor, waiting = self._open(), iter(list(jobs.items()))
        running: dict[Future[T], int] = {}
        while True:
            for number, job in islice(waiting, QUEUED * self._capacity - len(running)):
                running[executor.submit(function, job)] = number
            if not running:
                return
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(done), done.result()

    def _lost(self) -> ExecutorError:
        return ExecutorError(
            f"worker processes ended {LOSSES} times in a row before they had finished, most often for want of memory: "
            f"there were {self.count} of them; set executor.workers to fewer"
        )

    def _open(self) -> Executor:
        if self._executor is None:
            self._executor = self._of_cluster() if self.options.kind == "dask" else self._of_processes()
        return self._executor

    def _of_processes(self) -> Executor:
        pool = ProcessPoolExecutor(self.count, get_context("spawn"), _begin)
        self._capacity, self._close = self.count, lambda: pool.shutdown(cancel_futures=True)
        return pool

    def _of_cluster(self) -> Executor:
        try:
            from distributed import Client  # noqa: PLC0415 - of an extra
        except ImportError:
            raise ExecutorError(
                "executor is dask, which is not installed: pip install 'torchrefrac[cluster]'"
            ) from None
        try:
            client = Client(self.options.address, timeout=PATIENCE_S)
        except (OSError, ValueError) as problem:
            reason = str(problem).split("\n", maxsplit=1)[0]
            raise ExecutorError(
                f"no Dask scheduler answers at executor.address={self.options.address}: {reason}"
            ) from None
        threads: dict[str, int] = client.nthreads()  # type: ignore[assignment] - of a client that waits
        self._capacity, self._close = max(sum(threads.values()), 1), client.close
        return client.get_executor(pure=False)


def _begin() -> None:
    """What a process does first: it takes one thread, and ends with the process that has begun it."""
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
