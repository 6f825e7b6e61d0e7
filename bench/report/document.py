"""What the report consists of: questions, answers, figures and tables; and how it is written."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jinja2
import markupsafe

from . import svg

# Rows of a table in the Markdown, which is to be read; the page has all.
MARKDOWN_ROWS = 26
_KINDS = {".jpg": "image/jpeg", ".png": "image/png"}


@dataclass(frozen=True)
class Table:
    """Rows of cells: numbers are formatted, everything else is shown as it prints."""

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    caption: str = ""
    kind: str = "table"

    def cells(self) -> list[list[str]]:
        return [[shown(cell) for cell in row] for row in self.rows]


@dataclass(frozen=True)
class Figure:
    """A drawing, which is also written as `name`.svg."""

    name: str
    svg: str
    caption: str
    kind: str = "figure"


@dataclass(frozen=True)
class Picture:
    """An image file of the report's folder."""

    file: str
    caption: str
    kind: str = "picture"


@dataclass
class Answer:
    """What the numbers say to a question.

    Attributes
    ----------
    sentence : str
        The answer, made of the numbers.
    more : list of str
        Further sentences: where it does not hold, and what it is measured by.
    figure : Figure, optional
    table : Table, optional
        The numbers of the figure; the Markdown shows it as well.
    details : list
        Tables, figures and pictures that the page folds away.
    """

    sentence: str
    more: list[str] = field(default_factory=list)
    figure: Figure | None = None
    table: Table | None = None
    details: list[Table | Figure | Picture] = field(default_factory=list)


@dataclass
class Section:
    """A question as it stands in the report, and the commands that measure its parts again."""

    title: str
    answer: Answer
    commands: Sequence[str] = ()

    @property
    def anchor(self) -> str:
        return "-".join(word for word in "".join(_plain(self.title)).split())

    @property
    def figures(self) -> list[Figure]:
        own = [self.answer.figure] if self.answer.figure else []
        return own + [block for block in self.answer.details if isinstance(block, Figure)]


def _plain(title: str) -> str:
    return "".join(c for c in title.lower() if c.isalnum() or c == " ")


def shown(value: object) -> str:
    """A cell as text: numbers with three significant digits, two of them as a range."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "–"
        if value == 0:
            return "0"
        if 1e-3 <= abs(value) < 1e5:
            digits = max(0, 2 - math.floor(math.log10(abs(value))))
            return f"{value:.{digits}f}"
        return f"{value:.2e}"
    if isinstance(value, int) and abs(value) >= 1e7:
        return f"{value:.2e}"
    if isinstance(value, (list, tuple)):
        return (" … " if len(value) == 2 else ", ").join(shown(one) for one in value)
    return str(value)


def markdown(title: str, sections: Sequence[Section]) -> str:
    """The document as Markdown; figures lie beside it, details are left to the page."""
    lines = [f"# {title}", ""]
    for section in sections:
        answer = section.answer
        lines += [f"## {section.title}", "", answer.sentence, ""]
        lines += [line for text in answer.more for line in (f"- {text}", "")]
        if answer.figure:
            lines += [f"![{answer.figure.caption}]({answer.figure.name}.svg)", ""]
        if answer.table:
            lines += _markdown_table(answer.table)
        if section.commands:
            lines += [f"Measured by {', '.join(f'`{one}`' for one in section.commands)}.", ""]
    return "\n".join(lines)


def _markdown_table(table: Table) -> list[str]:
    cells = table.cells()
    rows = [list(map(str, table.columns)), ["---"] * len(table.columns), *cells[:MARKDOWN_ROWS]]
    lines = [f"**{table.caption}**", ""] if table.caption else []
    lines += ["| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in rows]
    if len(cells) > MARKDOWN_ROWS:
        lines += ["", f"The first {MARKDOWN_ROWS} of {len(cells)} rows."]
    return [*lines, ""]


def _marked(text: str) -> markupsafe.Markup:
    """A sentence as HTML: what stands between backticks is code."""
    return markupsafe.Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(markupsafe.escape(text))))


def html(title: str, about: str, sections: Sequence[Section], folder: Path) -> str:
    """The document as one HTML file that needs no other: pictures of `folder` are inlined."""

    def inline(file: str) -> str:
        path = folder / file
        data = base64.b64encode(path.read_bytes()).decode("ascii")
        return f"data:{_KINDS[path.suffix]};base64,{data}"

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["marked"] = _marked
    return environment.get_template("page.html.jinja").render(
        title=title, about=about, sections=sections, inline=inline, light=svg.style(False),
        dark=svg.style(True),
    )  # fmt: skip
