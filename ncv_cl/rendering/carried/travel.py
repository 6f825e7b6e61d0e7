"""Integrands that travel to workers: by name, or with the files of a class of somebody's own."""

from __future__ import annotations

import atexit
import hashlib
import inspect
import pickle
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ...host.files import write_whole
from ...integrands import Integrand, IntegrandError
from ...integrands.named import FILE_MODULE, module_of
from ...machines.values import pickled


@dataclass(frozen=True)
class TravellingIntegrand:
    """An integrand in a form that any process can make one of.

    Attributes
    ----------
    whole : bytes, optional
        The object, pickled, of a class in a module that workers can import.
    files : tuple of (str, str)
        Else names and texts of the class's Python file, first, and of its kernel files.
    name : str
        The class's name there.
    state : bytes
        The object's attributes, pickled.
    """

    whole: bytes | None
    files: tuple[tuple[str, str], ...] = ()
    name: str = ""
    state: bytes = b""

    @classmethod
    def of(cls, integrand: Integrand) -> TravellingIntegrand:
        """Pack an integrand.

        Raises
        ------
        CannotTravel
            If the object or an attribute of it cannot be pickled.
        IntegrandError
            If a file cannot be read.
        """
        kind = type(integrand)
        what = f"integrand {kind.__name__}"
        if not kind.__module__.startswith(FILE_MODULE):
            return cls(pickled(integrand, what))
        source = Path(inspect.getfile(kind))
        own = [file for file in integrand.files if isinstance(file, (str, Path))]
        texts = [source, *(source.parent / file for file in own if Path(file).suffix == ".cl")]
        outside = [str(path) for path in texts if source.parent not in path.parents]
        if outside:
            raise IntegrandError(
                f"{what}: its kernel file {outside[0]} is not in the folder of {source}: put it there, "
                "so that both can be sent to workers"
            )
        files = tuple((str(path.relative_to(source.parent)), path.read_text("utf-8")) for path in texts)
        return cls(None, files, kind.__qualname__, pickled(vars(integrand), what))

    def make(self) -> Integrand:
        """The integrand, in a worker."""
        if self.whole is not None:
            return pickle.loads(self.whole)
        digest = hashlib.sha256(repr(self.files).encode()).hexdigest()[:16]
        # A folder that nobody else can write to, and that stays: the class looks for its kernels there.
        folder = Path(tempfile.mkdtemp(prefix=f"ncv_cl-{digest}-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        for name, text in self.files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            _write(folder / name, text.encode())
        kind = getattr(module_of(folder / self.files[0][0]), self.name)
        made = kind.__new__(kind)
        vars(made).update(pickle.loads(self.state))
        return made


def _write(path: Path, content: bytes) -> None:
    write_whole(path, lambda file: file.write(content))
