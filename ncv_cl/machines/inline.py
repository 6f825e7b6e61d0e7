"""An executor that works in the calling thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future


class Inline(Executor):
    """Does each task at once, where it is handed in."""

    def submit(self, function: Callable[..., object], /, *args: object, **options: object) -> Future:
        future: Future = Future()
        try:
            future.set_result(function(*args, **options))
        except Exception as error:
            future.set_exception(error)
        return future
