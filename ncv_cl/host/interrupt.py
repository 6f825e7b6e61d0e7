"""Signals that end a render after the pass under way, with the picture so far."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any, TypeAlias

# Ctrl-C; what service and batch managers send before they kill; a terminal that is closed. Windows has
# no SIGHUP, and Ctrl-Break instead.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
# What `signal.getsignal` returns, and `signal.signal` takes.
_Handler: TypeAlias = Callable[[int, FrameType | None], Any] | int | signal.Handlers


class StopOnSignal:
    """While its block lasts, a first signal ends the render after this pass, a second one at once.

    Signals that were ignored when the program started, as under `nohup`, stay ignored. Python handles
    signals in the main thread only; in another thread this does nothing.

    Attributes
    ----------
    asked : bool
        Whether a signal has come.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, _Handler] = {}

    def __enter__(self) -> StopOnSignal:
        if threading.current_thread() is not threading.main_thread():
            return self
        for number in (getattr(signal, name) for name in _NAMES if hasattr(signal, name)):
            before = signal.getsignal(number)
            # None: the handler was not installed by Python, so it is left in place.
            if before is not None and before != signal.SIG_IGN:
                self._before[number] = before
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *error: object) -> None:
        self._restore()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        self._restore()
        again = "press Ctrl-C again" if number == signal.SIGINT else "send it again"
        # The terminal may be closed, or the stream in the middle of another write.
        with suppress(OSError, ValueError, RuntimeError):
            name = signal.Signals(number).name
            print(f"\n{name}: stopping after this pass; {again} to stop at once", file=sys.stderr)

    def _restore(self) -> None:
        while self._before:
            number, before = self._before.popitem()
            signal.signal(number, before)

    def __call__(self) -> bool:
        return self.asked
