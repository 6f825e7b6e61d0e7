"""Which files may be read: those of one folder, unless more was asked for."""

from __future__ import annotations

from pathlib import Path


class OutsideError(ValueError):
    """A file names another one outside of the folder that may be read."""


class Reach:
    """The files that a scene may name.

    Parameters
    ----------
    folder : Path or None
        They lie in here, or in a folder of it, once links are followed; None: they may lie anywhere.

    Attributes
    ----------
    checked_files : set of Path
        Whatever was asked for and may be read, links followed.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.checked_files: set[Path] = set()
        self._given = folder
        self._folder = None if folder is None else folder.resolve()

    def allows(self, path: Path) -> bool:
        """Whether a file or folder, which need not exist, may be read."""
        if self._folder is None:
            return True
        try:
            return path.resolve().is_relative_to(self._folder)
        except (OSError, RuntimeError, ValueError):  # links in a circle, a name that no file can have
            return False

    def checked(self, path: Path) -> Path:
        """The same path.

        Raises
        ------
        OutsideError
            If it may not be read.
        """
        if not self.allows(path):
            raise OutsideError(
                f"{path} lies outside of the scene's folder {self._given}; to read it, give "
                "--allow-outside, or load_scene(..., allow_outside=True)"
            )
        self.checked_files.add(path.resolve())
        return path
