"""Names and texts of the files that mesh files consist of."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from ...host.reach import OutsideError, Reach


def read_text(path: Path) -> list[str]:
    """The lines of a text file in UTF-8, in UTF-16 with a byte-order mark, else in Latin-1.

    Lines end with LF, CRLF or CR, tabs become blanks, and blanks around a line are taken off. A line
    that ends with a backslash goes on in the next, which is left empty: line numbers stay as they
    are. Comments (lines that begin with #) do not go on.

    Raises
    ------
    ValueError
        If the file cannot be read or is not a text.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from error
    text = decode(data)
    if "\0" in text:
        raise ValueError("cannot be read: it is not a text file")
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\t", " ")
    lines = [line.strip() for line in text.split("\n")]
    if "\\\n" in text or re.search(r"\\ +\n", text):
        _join_continued(lines)
    return lines


def decode(data: bytes) -> str:
    """Bytes as text: by their byte-order mark, else UTF-8, else Latin-1, which never fails."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.removeprefix(codecs.BOM_UTF8).decode("latin-1")


def _join_continued(lines: list[str]) -> None:
    for i in range(len(lines) - 2, -1, -1):
        if lines[i].endswith("\\") and not lines[i].startswith("#"):
            lines[i] = f"{lines[i][:-1]} {lines[i + 1]}".strip()
            lines[i + 1] = ""


def find_file(folder: Path, name: str, reach: Reach) -> Path | None:
    """The file that another one in `folder` names, or None.

    Backslashes separate folders as slashes do, upper and lower case are alike where no file is
    spelled exactly so, and a path that does not exist here, or that is beyond `reach`, stands for its
    last part in `folder`.

    Raises
    ------
    OutsideError
        If there is such a file, but only beyond `reach`.
    """
    name = name.strip().strip('"').replace("\\", "/")
    if not name:
        return None
    outside: OutsideError | None = None
    for candidate in (folder / name, folder / name.rsplit("/", 1)[-1]):
        try:
            found = _spelled_so(candidate, reach.allows(candidate.parent))
            if found is not None:
                return reach.checked(found)
        except OSError:  # no such folder, or a name that no file can have
            continue
        except OutsideError as error:
            outside = outside or error
    if outside is not None:
        raise outside
    return None


def _spelled_so(path: Path, may_list: bool) -> Path | None:
    """The file of a path, or if its folder may be listed, one that differs in upper and lower case."""
    if path.is_file():
        return path
    for entry in path.parent.iterdir() if may_list else ():
        if entry.name.lower() == path.name.lower() and entry.is_file():
            return entry
    return None
