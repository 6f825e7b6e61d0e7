"""Any JSON as tables: for parts whose layout the report does not know more about."""

from __future__ import annotations

from .document import Table

# A table in the report is to be read; what is longer is cut, and its file named.
LONGEST = 40
# More columns than this are split: a table for each nested record, beside what identifies its rows.
WIDEST = 12
_SCALARS = (str, int, float, bool, type(None))


def tables(value: object, name: str) -> list[Table]:
    """Every list of records, record of records and record of scalars in `value`, as a table each.

    Parameters
    ----------
    value : object
        What a JSON file holds.
    name : str
        Heads the captions; nested tables add their keys to it.
    """
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        return _records(value, name)
    if not isinstance(value, dict):
        return []
    nested = {key: one for key, one in value.items() if isinstance(one, (dict, list))}
    scalars = {key: one for key, one in value.items() if isinstance(one, _SCALARS)}
    if not scalars and len(nested) > 1 and all(_flat(one) for one in nested.values()):
        return _records([{"": key, **one} for key, one in nested.items()], name)
    found = [Table(["", "value"], list(scalars.items()), name)] if scalars else []
    for key, one in nested.items():
        if _short(one):
            found.append(Table([key], [[one]], name))
        else:
            found += tables(one, f"{name}: {key}")
    return found


def _flat(value: object) -> bool:
    """Whether a record fits in one row."""
    return isinstance(value, dict) and all(
        isinstance(one, _SCALARS) or _short(one) for one in value.values()
    )


def _short(value: object) -> bool:
    """Whether a list fits in a cell."""
    return (
        isinstance(value, list) and len(value) <= 8 and all(isinstance(one, _SCALARS) for one in value)
    )


def _records(records: list[dict], name: str) -> list[Table]:
    nested = list(dict.fromkeys(k for row in records for k, one in row.items() if isinstance(one, dict)))
    if nested and max(len(_flatten(record)) for record in records) > WIDEST:
        own = [{k: one for k, one in row.items() if not isinstance(one, dict)} for row in records]
        return [
            table
            for key in nested
            for table in _records(
                [one | row.get(key, {}) for one, row in zip(own, records, strict=True)], f"{name}: {key}"
            )
        ]
    rows = [_flatten(record) for record in records]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    # One cell that all rows share is said once, in the caption.
    same = {c for c in columns if len(rows) > 2 and len({repr(row.get(c)) for row in rows}) == 1}
    caption = name + "".join(f", {c} {rows[0][c]}" for c in columns if c in same)
    kept = [column for column in columns if column not in same]
    if len(rows) > LONGEST:
        caption += f" (the first {LONGEST} of {len(rows)} rows)"
    found = [Table(kept, [[row.get(c) for c in kept] for row in rows[:LONGEST]], caption)]
    for record in records:
        label = " ".join(str(one) for one in record.values() if isinstance(one, str))[:80]
        for key, one in record.items():
            if isinstance(one, list) and not _short(one):
                found += tables(one, f"{name}: {label} {key}")
    return found


def _flatten(record: dict, prefix: str = "") -> dict[str, object]:
    """A record's scalars and short lists, nested ones under dotted names."""
    row: dict[str, object] = {}
    for key, one in record.items():
        if isinstance(one, dict):
            row |= _flatten(one, f"{prefix}{key}.")
        elif isinstance(one, _SCALARS) or _short(one):
            row[f"{prefix}{key}"] = one
    return row
