"""Values that tasks share, by digest: each travels to a worker once, and is kept there.

A task names what it needs by digests. A worker that lacks a value looks into the shared folder, if there
is one; else it answers what it misses, and the task comes again with it.
"""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path

from ..host.files import write_whole

# Hex digits of a digest: 128 bits of SHA-256.
DIGITS = 32
# Pickled bytes of the values that a process keeps; those that were not used for longest go first.
BYTES_KEPT = 1 << 30


class CannotTravel(ValueError):
    """Something that workers need cannot be sent to them; the message says what, and what to do."""


class Missing(LookupError):
    """Values that this process has not got; `keys` are their digests."""

    def __init__(self, keys: list[str]) -> None:
        super().__init__(f"values {', '.join(keys)} are not here")
        self.keys = keys


class Kept:
    """The values that a process keeps, of several threads at once."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._found: OrderedDict[str, tuple[object, int]] = OrderedDict()

    def put(self, key: str, value: object, size: int) -> None:
        """Keep a value of so many pickled bytes; the last one is kept however large it is."""
        with self._lock:
            self._found[key] = (value, size)
            self._found.move_to_end(key)
            while len(self._found) > 1 and sum(one for _, one in self._found.values()) > BYTES_KEPT:
                self._found.popitem(last=False)

    def forget(self, key: str) -> None:
        """Keep a value no longer."""
        with self._lock:
            self._found.pop(key, None)

    def fetch(
        self, keys: Iterable[str], given: dict[str, bytes], shared: str | None
    ) -> dict[str, object]:
        """The values of these digests, by digest.

        Parameters
        ----------
        given : dict of bytes
            Pickled values that came with the task.
        shared : str, optional
            The shared folder.

        Raises
        ------
        Missing
            For those that are neither kept, given nor in the folder.
        """
        found, missing = {}, []
        for key in keys:
            with self._lock:
                if key in self._found:
                    self._found.move_to_end(key)
                    found[key] = self._found[key][0]
                    continue
            data = given.get(key) or _shared(shared, key)
            if data is None:
                missing.append(key)
                continue
            found[key] = pickle.loads(data)
            self.put(key, found[key], len(data))
        if missing:
            raise Missing(missing)
        return found


KEPT = Kept()


def digest_of(data: bytes) -> str:
    """The name of a pickled value."""
    return hashlib.sha256(data).hexdigest()[:DIGITS]


def _shared(folder: str | None, key: str) -> bytes | None:
    """What the shared folder holds under a digest; None: nothing, or something else."""
    if folder is None:
        return None
    with contextlib.suppress(OSError):
        data = (Path(folder) / key).read_bytes()
        return data if digest_of(data) == key else None
    return None


class Values:
    """The values that a render's tasks need, on the side that sends them.

    Parameters
    ----------
    shared : str or Path, optional
        A folder that this process and all workers see: values are files there, and are not sent.
    """

    def __init__(self, shared: str | Path | None = None) -> None:
        self.shared = None if shared is None else str(shared)
        self._data: dict[str, bytes] = {}
        self._own: list[str] = []

    def put(self, value: object, what: str) -> str:
        """The digest of a value, under which workers will find it.

        Raises
        ------
        CannotTravel
            Naming `what` it is, if it cannot be pickled.
        OSError
            If the shared folder cannot be written to.
        """
        data = pickled(value, what)
        key = digest_of(data)
        KEPT.put(key, value, len(data))
        self._own.append(key)
        if self.shared is None:
            self._data[key] = data
        elif _shared(self.shared, key) is None:
            write_whole(Path(self.shared) / key, lambda file: file.write(data))
        return key

    def close(self) -> None:
        """Let go of all values; files stay."""
        self._data.clear()
        for key in self._own:
            KEPT.forget(key)

    def of(self, keys: Iterable[str]) -> dict[str, bytes]:
        """Pickled values to be sent.

        Raises
        ------
        CannotTravel
            If workers ask for what they should have found in the shared folder.
        """
        lost = [key for key in keys if key not in self._data]
        if lost:
            raise CannotTravel(
                f"a worker does not find {lost[0]} in the shared folder {self.shared}: all workers must "
                "see the folder under this name; or leave shared out, and values are sent"
            )
        return {key: self._data[key] for key in keys}


def pickled(value: object, what: str) -> bytes:
    """The bytes of a value; CannotTravel if it has none."""
    try:
        return pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        # What cannot be pickled raises one of several classes, of anybody's.
        raise CannotTravel(
            f"{what} cannot be sent to workers ({type(error).__name__}: {error}): define it by name at "
            "the top of a module that workers can import"
        ) from error
