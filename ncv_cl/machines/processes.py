"""Worker processes on this machine that are replaced when one is killed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from .worker import THREADS_VARIABLE


class Processes(Executor):
    """An executor of spawned processes that share the machine's cores.

    `ProcessPoolExecutor` does no more work once a process of it was killed; here others take its place.
    Programs that use this need ``if __name__ == "__main__":``, as all that spawn processes do.

    Parameters
    ----------
    number : int
        Processes.
    """

    def __init__(self, number: int) -> None:
        if isinstance(number, bool) or int(number) != number or number < 1:
            raise ValueError(f"processes must be a whole number of at least 1, got {number!r}")
        self._max_workers = int(number)
        self._lock = threading.Lock()
        self._closed = False
        self._pool = self._new()

    def _new(self) -> ProcessPoolExecutor:
        threads = max(1, (os.cpu_count() or 1) // self._max_workers)
        spawn = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self._max_workers, spawn, _begin, (threads,))

    def submit(self, function: Callable[..., object], /, *args: object, **options: object) -> Future:
        with self._lock:
            if self._closed:
                raise RuntimeError("these processes were shut down")
            try:
                return self._pool.submit(function, *args, **options)
            except BrokenProcessPool:
                self._pool.shutdown(wait=False)
                self._pool = self._new()
                return self._pool.submit(function, *args, **options)

    def replace(self) -> None:
        """Kill all processes, as where one hangs: what they do fails, and others take their place."""
        with self._lock:
            # The pool's own way to do it came with Python 3.14.
            for process in list((self._pool._processes or {}).values()):
                with contextlib.suppress(OSError, ValueError):
                    process.kill()
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = self._new()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        with self._lock:
            self._closed = True
            self._pool.shutdown(wait, cancel_futures=cancel_futures)


def _begin(threads: int) -> None:
    """Prepare a process: Ctrl-C is for the parent, which then cancels what waits; cores are shared."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault(THREADS_VARIABLE, str(threads))
    # Read by PoCL when it is first used.
    os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", str(threads))
