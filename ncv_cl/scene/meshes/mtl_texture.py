"""Statements of textures in MTL files: options, then the name of a file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

# Arguments of options; -o, -s and -t have up to three.
_ARGUMENTS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
# Values of options that leave an image as it is. Bump maps have -bm, highlights -boost.
_WITHOUT_EFFECT = {
    "-mm": ["0", "1"], "-t": ["0", "0", "0"], "-cc": ["off"], "-blendu": None, "-blendv": None,
    "-bm": None, "-boost": None, "-texres": None, "-imfchan": None, "-type": None,
}  # fmt: skip


@dataclass
class TextureStatement:
    """What a statement says.

    Attributes
    ----------
    file : str
    scale, offset : list of float
        Along u and v.
    wrap : str
        As in `Texture`, along both axes.
    left_out : str
        Options that would change the image and are not read.
    """

    file: str = ""
    scale: list[float] = field(default_factory=lambda: [1.0, 1.0])
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0])
    wrap: str = "repeat"
    left_out: str = ""

    @property
    def placement(self) -> tuple[float, float, float, float, float, float]:
        """As in `Maps`."""
        return (self.scale[0], 0.0, self.offset[0], 0.0, self.scale[1], self.offset[1])

    @property
    def placed(self) -> tuple[object, ...]:
        """What is alike for images that lie alike on a surface."""
        return (*self.placement, self.wrap)


def read_texture_statement(text: str) -> TextureStatement:
    """The options and the file of a texture statement."""
    found = TextureStatement()
    words, left_out = text.split(), []
    while len(words) > 1 and words[0].startswith("-"):
        option, values = words.pop(0).lower(), []
        limit = _ARGUMENTS.get(option, 1)
        fewest = 1 if limit == 3 else limit
        for i in range(limit):
            if len(words) > 1 and (i < fewest or _is_number(words[0])):
                values.append(words.pop(0))
            else:
                break
        if option in ("-s", "-o") and all(map(_is_number, values)):
            target = found.scale if option == "-s" else found.offset
            target[: len(values[:2])] = [float(value) for value in values[:2]]
        elif option == "-clamp":
            found.wrap = "clamp" if values == ["on"] else "repeat"
        elif not _has_no_effect(option, values):
            left_out.append(" ".join([option, *values]))
    found.file, found.left_out = " ".join(words), " ".join(left_out)
    return found


def _has_no_effect(option: str, values: list[str]) -> bool:
    if option not in _WITHOUT_EFFECT:
        return False
    expected = _WITHOUT_EFFECT[option]
    return expected is None or values == expected[: len(values)]


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
