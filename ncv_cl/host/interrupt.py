"""Signals that ask a render to end: with the picture so far, not in the middle of a pass."""

from __future__ import annotations

import signal
import sys
import threading
from contextlib import suppress
from types import FrameType

# Ctrl-C; what service and batch managers send before they kill; a terminal that is closed. Windows has
# no SIGHUP, and Ctrl-Break instead.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")


class StopOnSignal:
    """While its block lasts, one signal asks for the end after the pass under way; two end at once.

    Signals that whoever started the program has told it to ignore, as `nohup` does, stay ignored. Python
    handles signals in the main thread only, so in another one there is nothing to wait for.

    Attributes
    ----------
    asked : bool
        Whether a signal has come.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> StopOnSignal:
        if threading.current_thread() is not threading.main_thread():
            return self
        for number in (getattr(signal, name) for name in _NAMES if hasattr(signal, name)):
            before = signal.getsignal(number)
            # None: a handler that is not Python's, and not ours to replace.
            if before not in (signal.SIG_IGN, None):
                self._before[number] = before
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *error: object) -> None:
        self._restore()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        self._restore()
        again = "press Ctrl-C again" if number == signal.SIGINT else "send it again"
        # A closed terminal takes no message, nor does a stream in the middle of another one.
        with suppress(OSError, ValueError, RuntimeError):
            name = signal.Signals(number).name
            print(f"\n{name}: stopping after this pass; {again} to stop at once", file=sys.stderr)

    def _restore(self) -> None:
        while self._before:
            signal.signal(*self._before.popitem())

    def __call__(self) -> bool:
        return self.asked
