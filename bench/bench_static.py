"""What GPUs' compilers make of the kernels, and what the paper model says: the tables of two pages.

`docs/gpu_kernels.md` is written and checked by tests/test_gpu_static.py, `docs/gpu_model.md` says what
an image would take on GPUs that are not here. Both are read, nothing is measured.

    python bench/bench_static.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
PAGES = {"kernels": "gpu_kernels.md", "model": "gpu_model.md"}


def tables_of(text: str) -> list[dict[str, object]]:
    """Every table of a Markdown page: the heading above it, its columns, its rows as they stand."""
    found: list[dict[str, object]] = []
    heading, rows = "", []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip().strip("`") for cell in line.strip().strip("|").split("|")])
            continue
        if len(rows) > 2:
            # The second row is the rule below the columns.
            found.append({"heading": heading, "columns": rows[0], "rows": rows[2:]})
        rows = []
        if line.startswith("#"):
            heading = line.lstrip("# ")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the same")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the tables here")
    options = parser.parse_args()
    found = {}
    for name, page in PAGES.items():
        file = DOCS / page
        found[name] = tables_of(file.read_text(encoding="utf-8")) if file.exists() else []
        print(f"docs/{page}: {sum(len(table['rows']) for table in found[name])} rows")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
