"""Integration in a process of its own, so that a kernel may crash or hang and be counted.

A batch in which that happens is cut in halves, and they again, until the networks that cause it are
alone. So is a batch that the package refuses because a point has no finite result.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

import numpy as np
from rational import Network

from ncv_cl.integration.integrate import integrate
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device, open_device

# Seconds for one batch, the compiler's included, on a machine that is busy with other things; and the
# share of it for a part of a batch, for which all is compiled.
TIME_LIMIT, PART_SHARE = 90.0, 1 / 3
# What `Statistics` counts besides points that needed more than the arrangement.
NOT_REDONE = ("points", "faces", "scratch_bytes")


class CrashError(Exception):
    """The process that integrated a batch died, hung or raised what it must not raise."""


class RefusedError(Exception):
    """The package says of a batch that some point has no finite result."""


@dataclass
class Outcome:
    """What came of a batch.

    Attributes
    ----------
    values : (points, channels) float64
    bounds : (points, channels) float64
        What the package says of |value - exact| at most; infinite if it does not say.
    answered : (points,) bool
        False for networks that were refused, or that crash on their own.
    refused : int
        Networks that the package says it cannot integrate.
    crash : str
        How the whole batch crashed at first; empty if it did not.
    lost : int
        Networks that crash on their own.
    redone : Counter
        Points that needed more than the arrangement, by the names of `Statistics`.
    """

    values: np.ndarray
    bounds: np.ndarray
    answered: np.ndarray
    refused: int = 0
    crash: str = ""
    lost: int = 0
    redone: Counter = field(default_factory=Counter)


class Worker:
    """A process that integrates with given options, started anew whenever it dies or hangs.

    Parameters
    ----------
    selector : str, optional
        The device, as for `choose_device`.
    shape : (vector_width, lanes)
        Of the device; those of a GPU can be tried on a CPU.
    options : keyword arguments of `integrate`
    """

    def __init__(
        self,
        selector: str | None,
        shape: tuple[int, int],
        options: dict,
        limit: float = TIME_LIMIT,
    ) -> None:
        self._arguments = selector, shape, options
        self._limit = limit
        self._context = multiprocessing.get_context("spawn")
        self._start()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def integrate(self, batch: Network) -> Outcome:
        """Integrate a batch of networks, all arrays with a points axis, whatever happens."""
        points, channels = batch[1][-1].shape
        outcome = Outcome(
            np.full((points, channels), np.nan),
            np.full((points, channels), np.inf),
            np.zeros(points, bool),
        )
        pending = [slice(0, points)]
        while pending:
            part = pending.pop()
            try:
                limit = self._limit * (1 if part == slice(0, points) else PART_SHARE)
                values, bounds, redone = self._ask(some_networks(batch, part), limit)
            except (CrashError, RefusedError) as error:
                crashed = isinstance(error, CrashError)
                if crashed:
                    outcome.crash = outcome.crash or str(error)
                if part.stop - part.start > 1:
                    middle = (part.start + part.stop) // 2
                    pending += [slice(part.start, middle), slice(middle, part.stop)]
                elif crashed:
                    outcome.lost += 1
                else:
                    outcome.refused += 1
                continue
            outcome.values[part], outcome.answered[part] = values, True
            if bounds is not None:
                outcome.bounds[part] = bounds.reshape(len(values), -1)
            outcome.redone += redone
        return outcome

    @staticmethod
    def serve(
        connection: Connection, selector: str | None, shape: tuple[int, int], options: dict
    ) -> None:
        """What the process does: integrate every batch that comes, until the connection ends."""
        device = choose_device(selector)
        device = open_device(device.cl_device, device.index, *shape, device.use_fma)
        while True:
            try:
                batch = connection.recv()
            except EOFError:
                return
            connection.send(_answer(device, batch, options))

    def _ask(self, batch: Network, limit: float) -> tuple[np.ndarray, np.ndarray | None, Counter]:
        try:
            self._connection.send(batch)
            if not self._connection.poll(limit):
                self._restart()
                raise CrashError(f"no answer after {limit:.0f} s")
            answer = self._connection.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            death = _death(self._process.exitcode)
            self._restart()
            raise CrashError(death) from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _start(self) -> None:
        self._connection, theirs = self._context.Pipe()
        self._process = self._context.Process(
            target=self.serve, args=(theirs, *self._arguments), daemon=True
        )
        self._process.start()
        # Ours alone keeps the pipe open, so that its end tells of the process's.
        theirs.close()

    def _stop(self) -> None:
        self._connection.close()
        self._process.kill()
        self._process.join()

    def _restart(self) -> None:
        self._stop()
        self._start()


def _answer(device: Device, batch: Network, options: dict) -> tuple | Exception:
    try:
        values, bounds, statistics = integrate(
            *batch, device=device, return_bound=True, return_stats=True, **options
        )
    except FloatingPointError as error:
        return RefusedError(str(error))
    # Whatever else it raises is no answer to a network that is valid.
    except Exception as error:
        return CrashError(f"{type(error).__name__}: {error}")
    counts = {name: getattr(statistics, name) for name in ("robust_points", *vars(statistics))}
    redone = {k: n for k, n in counts.items() if k not in NOT_REDONE and isinstance(n, int)}
    return values, bounds, Counter(redone)


def some_networks(batch: Network, part: slice) -> Network:
    """Networks of a batch whose arrays all have a points axis."""
    return [w[part] for w in batch[0]], [b[part] for b in batch[1]]


def _death(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return signal.Signals(-exitcode).name
    return f"exit status {exitcode}"
