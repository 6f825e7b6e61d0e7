"""Tasks for any `concurrent.futures.Executor`: sent, sent again where they fail, and counted."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from dataclasses import dataclass, field
from typing import Any

from .processes import Processes
from .values import CannotTravel, Values, pickled
from .worker import Answer, work

# A task is tried so often: it may be among others whose worker was killed, and one may be killed twice.
MOST_TRIES = 4
# Tasks at first where the executor does not say how many workers it has; then twice as many as there are
# workers that have done one, so that each has another to go on with.
FIRST_TASKS = 4
# Seconds between two looks at the clock and at whether to stop.
POLL = 0.1


class TaskError(RuntimeError):
    """A task failed on every worker that tried it; the render's checkpoint holds what was done."""


@dataclass(eq=False)
class Job:
    """A task: function(values, *arguments) on some worker.

    Attributes
    ----------
    name : str
        For messages.
    keys : tuple of str
        Digests of the values that it needs.
    """

    name: str
    function: Callable[..., object]
    keys: tuple[str, ...]
    arguments: tuple[Any, ...]
    tries: int = 0
    said: str = ""
    given: dict[str, bytes] = field(default_factory=dict)


@dataclass
class WorkerCount:
    """What a worker has done: tasks, seconds in them, and bytes that were sent to it."""

    tasks: int = 0
    seconds: float = 0.0
    processor_seconds: float = 0.0
    task_bytes: int = 0
    value_bytes: int = 0


class Crew:
    """The workers of an executor.

    Parameters
    ----------
    executor : Executor
    values : Values
    limit : float
        Seconds after which a task is given to another worker.
    stop : callable
        Asked now and then; True ends `run`, and cancels what waits.

    Attributes
    ----------
    workers : dict of WorkerCount
        By the worker's name.
    task_bytes : list of int
        Of every task that was sent, without values.
    retries, late : int
        Tasks that were sent again because they failed, and because they took too long.
    stopped : bool
        Whether `run` ended because of `stop`.
    """

    def __init__(
        self, executor: Executor, values: Values, limit: float, stop: Callable[[], bool]
    ) -> None:
        check_executor(executor)
        self._executor, self._limit, self._stop = executor, limit, stop
        self.values = values
        self.workers: dict[str, WorkerCount] = {}
        self.task_bytes: list[int] = []
        self.retries = self.late = 0
        self.stopped = False
        self._own: Processes | None = None
        self._numbers = itertools.count()
        known = getattr(executor, "_max_workers", None)
        self._first = known if isinstance(known, int) and known > 0 else FIRST_TASKS
        # By future: the job, when it was sent, and bytes of task and of values.
        self._sent: dict[Future, tuple[Job, float, int, int]] = {}

    def run(self, jobs: Iterable[Job]) -> Iterator[tuple[Job, Answer]]:
        """Jobs and their answers, in the order in which they are done; all of them, or until `stop`.

        Raises
        ------
        TaskError
            When a job has failed `MOST_TRIES` times.
        """
        waiting: deque[Job] = deque()
        coming, self.stopped = iter(jobs), False
        try:
            while True:
                if not self.stopped and self._stop():
                    self.stopped = True
                    waiting, coming = deque(), iter(())
                    self._cancel()
                while len(self._sent) < max(self._first, 2 * len(self.workers)):
                    job = waiting.popleft() if waiting else next(coming, None)
                    if job is None:
                        break
                    self._send(job, waiting)
                if not waiting and not self._sent:
                    break
                yield from self._gathered(waiting)
        finally:
            self._cancel()
            self._sent.clear()

    def _cancel(self) -> None:
        for future in list(self._sent):
            if future.cancel():
                del self._sent[future]

    def _send(self, job: Job, waiting: deque[Job]) -> None:
        """Hand a job to the executor, with what it brings along."""
        given = job.given
        task = (job.function, job.keys, job.arguments, self.values.shared, next(self._numbers))
        size = len(pickled(task, job.name))
        try:
            future = self._executor.submit(work, *task, given)
        except (BrokenExecutor, RuntimeError) as error:
            if self._replace_executor(error):
                waiting.appendleft(job)
            else:
                self._failed(job, error, waiting)
            return
        self.task_bytes.append(size)
        self._sent[future] = (job, time.perf_counter(), size, sum(map(len, given.values())))

    def _gathered(self, waiting: deque[Job]) -> Iterator[tuple[Job, Answer]]:
        """What is done by now, after a short wait if nothing is."""
        done, _ = wait(list(self._sent), POLL, FIRST_COMPLETED)
        for future in done:
            job, _, size, value_size = self._sent.pop(future)
            if future.cancelled():
                self._failed(job, RuntimeError("it was cancelled"), waiting)
                continue
            error = future.exception()
            if error is not None:
                self._failed(job, error, waiting)
                continue
            answer = future.result()
            count = self.workers.get(answer.worker, WorkerCount())
            count.task_bytes += size
            count.value_bytes += value_size
            if answer.missing:
                # To the front: others need the same values, and wait for no other reason.
                job.given = self.values.of(answer.missing)
                waiting.appendleft(job)
            else:
                self.workers[answer.worker] = count
                count.tasks += 1
                count.seconds += answer.seconds
                count.processor_seconds += answer.processor_seconds
                yield job, answer
        self._look_for_late(waiting)

    def _failed(self, job: Job, error: BaseException, waiting: deque[Job]) -> None:
        """Try a job once more, if it may be."""
        job.tries += 1
        job.said = f"{type(error).__name__}: {error}"
        if self.stopped:
            return
        if isinstance(error, CannotTravel):
            raise error
        if job.tries >= MOST_TRIES:
            raise TaskError(
                f"{job.name} failed {job.tries} times, last with {job.said}; what was done before is in "
                "the checkpoint, if one was asked for, and resume goes on from there"
            ) from error
        self.retries += 1
        waiting.append(job)

    def _look_for_late(self, waiting: deque[Job]) -> None:
        """Give up tasks that take too long, and try them elsewhere."""
        now = time.perf_counter()
        late = [one for one, (_, sent, _, _) in self._sent.items() if now - sent > self._limit]
        if not late:
            return
        for future in late:
            job, *_ = self._sent.pop(future)
            future.cancel()
            self.late += 1
            self._failed(job, TimeoutError(f"no answer after {self._limit:g} s"), waiting)
        if isinstance(self._executor, Processes):
            # Those that hang would keep their places.
            self._executor.replace()

    def _replace_executor(self, error: BaseException) -> bool:
        """A process pool that is broken never works again: others of its kind take over."""
        old = self._executor
        if not isinstance(old, ProcessPoolExecutor) or not isinstance(error, BrokenExecutor):
            return False
        # Private, and said nowhere else.
        workers = old._max_workers  # type: ignore[attr-defined]
        self._executor = self._own = Processes(workers)
        return True

    def close(self) -> None:
        """End the processes that replaced broken ones."""
        if self._own is not None:
            self._own.shutdown(wait=False, cancel_futures=True)

    def statistics(self) -> dict[str, object]:
        """Counts for an image's statistics."""
        sent = self.task_bytes or [0]
        return {
            "tasks": sum(one.tasks for one in self.workers.values()),
            "sent": len(self.task_bytes),
            "retries": self.retries,
            "late": self.late,
            "bytes_a_task": sum(sent) / len(sent),
            "most_bytes_a_task": max(sent),
            "workers": {name: dict(vars(count)) for name, count in sorted(self.workers.items())},
        }


def check_executor(executor: object) -> None:
    """Refuse what is no executor, and processes that are forked.

    Raises
    ------
    ValueError
        Saying what to give instead.
    """
    if not callable(getattr(executor, "submit", None)):
        raise ValueError(
            f"executor must be a concurrent.futures.Executor, got {executor!r}: ncv.Processes(4), or "
            "client.get_executor() of Dask"
        )
    context = executor._mp_context if isinstance(executor, ProcessPoolExecutor) else None
    if context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "executor forks its processes, and OpenCL does not survive a fork: take ncv.Processes(4), "
            "or ProcessPoolExecutor(4, mp_context=multiprocessing.get_context('spawn'))"
        )
