"""A document of paragraphs, tables and figures, and how it becomes HTML and Markdown."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jinja2


@dataclass(frozen=True)
class Paragraph:
    """Plain text; `finding` ones are what was measured, said in a sentence."""

    text: str
    finding: bool = False
    kind: str = "paragraph"


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
    """A PNG file in the report's folder, and the command that makes it again."""

    file: str
    caption: str
    command: str
    kind: str = "figure"


@dataclass
class Section:
    """A heading and what stands below it."""

    title: str
    blocks: list[Paragraph | Table | Figure] = field(default_factory=list)

    @property
    def findings(self) -> list[str]:
        """The sentences that say what was measured."""
        return [b.text for b in self.blocks if isinstance(b, Paragraph) and b.finding]


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


def markdown(title: str, sections: list[Section]) -> str:
    """The document as Markdown; figures lie beside it."""
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for block in section.blocks:
            if isinstance(block, Paragraph):
                lines += [f"- {block.text}" if block.finding else block.text, ""]
            elif isinstance(block, Table):
                lines += [f"**{block.caption}**", ""] if block.caption else []
                lines += _markdown_table(block)
            else:
                lines += [f"![{block.caption}]({block.file})", "", f"{block.caption} `{block.command}`"]
                lines += [""]
    return "\n".join(lines)


def _markdown_table(table: Table) -> list[str]:
    rows = [list(map(str, table.columns)), ["---"] * len(table.columns), *table.cells()]
    return [*("| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in rows), ""]


_PAGE = jinja2.Template(
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #222; }
body { max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h2 { border-bottom: 1px solid #ccc; margin-top: 2.5rem; }
table { border-collapse: collapse; font-size: 13px; margin: 0.5rem 0 1.5rem; }
caption { text-align: left; font-weight: 600; padding: 0.3rem 0; }
th, td { padding: 0.2rem 0.6rem; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; }
th { background: #f4f4f4; }
.scroll { overflow-x: auto; }
.finding { border-left: 3px solid #47a; padding-left: 0.8rem; }
figure { margin: 1rem 0 2rem; } img { max-width: 100%; } figcaption { font-size: 13px; }
code, pre { background: #f4f4f4; padding: 0.1rem 0.3rem; font-size: 13px; }
</style></head><body>
<h1>{{ title }}</h1>
<ul>
{% for section in sections %}<li><a href="#s{{ loop.index }}">{{ section.title }}</a></li>
{% endfor %}</ul>
{% for section in sections %}<h2 id="s{{ loop.index }}">{{ section.title }}</h2>
{% for block in section.blocks %}
{% if block.kind == "paragraph" %}<p class="{{ "finding" if block.finding }}">{{ block.text }}</p>
{% elif block.kind == "table" %}<div class="scroll"><table>
{% if block.caption %}<caption>{{ block.caption }}</caption>{% endif %}
<tr>{% for column in block.columns %}<th>{{ column }}</th>{% endfor %}</tr>
{% for row in block.cells() %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table></div>
{% else %}<figure><img alt="{{ block.caption }}" src="data:image/png;base64,{{ inline(block.file) }}">
<figcaption>{{ block.caption }} <code>{{ block.command }}</code></figcaption></figure>
{% endif %}{% endfor %}{% endfor %}
</body></html>
""",
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
)


def html(title: str, sections: list[Section], folder: Path) -> str:
    """The document as one HTML file that needs no other: pictures of `folder` are inlined."""

    def inline(file: str) -> str:
        return base64.b64encode((folder / file).read_bytes()).decode("ascii")

    return _PAGE.render(title=title, sections=sections, inline=inline)
