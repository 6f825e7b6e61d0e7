"""What a worker does with a task, whichever executor brought it."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .values import KEPT, Missing

# Variables of which batch systems and MPI tell the number of a process on its machine.
LOCAL_RANKS = ("SLURM_LOCALID", "OMPI_COMM_WORLD_LOCAL_RANK", "MPI_LOCALRANKID", "PMI_LOCAL_RANK")
# Host threads of a worker, where several share a machine.
THREADS_VARIABLE = "NCV_CL_THREADS"


@dataclass(frozen=True)
class Answer:
    """What came of a task.

    Attributes
    ----------
    worker : str
        Machine, process and thread.
    result : object
        What the task's function returned; None if values were missing.
    missing : list of str
        Digests of these.
    seconds, processor_seconds : float
        Of the task; processor seconds are those of the whole process meanwhile.
    """

    worker: str
    result: Any
    missing: list[str]
    seconds: float
    processor_seconds: float


def work(
    function: Callable[..., object],
    keys: tuple[str, ...],
    arguments: tuple[object, ...],
    shared: str | None,
    number: int,
    given: dict[str, bytes],
) -> Answer:
    """Call function(values, *arguments), `values` being those of `keys` by digest.

    `number` tells tries apart: an executor that remembers results must not repeat a failure.
    """
    started, used = time.perf_counter(), time.process_time()
    result, missing = None, []
    try:
        values = KEPT.fetch(keys, given, shared)
    except Missing as error:
        missing = error.keys
    else:
        result = function(values, *arguments)
    seconds, spent = time.perf_counter() - started, time.process_time() - used
    return Answer(worker_name(), result, missing, seconds, spent)


def worker_name() -> str:
    """Machine, process and thread of who asks."""
    return f"{socket.gethostname()}:{os.getpid()}:{threading.get_ident() & 0xFFFF:04x}"


def local_rank() -> int:
    """The number of this process on its machine, as a batch system or MPI counts; 0 without one."""
    found = (os.environ.get(name, "") for name in LOCAL_RANKS)
    return next((int(text) for text in found if text.isdecimal()), 0)


def worker_threads(asked: int | None) -> int | None:
    """Host threads: as asked for, else what this worker was given; None: all cores."""
    given = os.environ.get(THREADS_VARIABLE, "")
    return asked or (int(given) if given.isdecimal() and int(given) else None)
