"""Records as tables: cells of text for the terminal and for Markdown. No torch here."""

from __future__ import annotations

from typing import Any

_HIDDEN = ("scene", "brick_size", "border", "stages")  # for plots and programs
_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))


def columns(record: dict[str, Any]) -> list[str]:
    """Returns the fields of a record's rows, in the order in which they first appear."""
    names = dict.fromkeys(name for row in record["rows"] for name in row)
    return [name for name in names if name not in _HIDDEN]


def heading(name: str) -> str:
    """Returns a field's name as a column's heading."""
    return name.replace("_per_second", " / s").replace("_", " ")


def cell(name: str, value: Any) -> str:
    """Returns a figure as text: rates and bytes with prefixes, shares in percent."""
    if value is None or isinstance(value, (bool, str)):
        return {"True": "yes", "False": "no", "None": ""}.get(str(value), str(value))
    if name.endswith("share"):
        return f"{value:.1%}"
    if name.endswith(("bytes", "bytes_per_second")):
        return f"{_prefixed(value)}B"
    return _prefixed(value).rstrip() if abs(value) >= 1e4 else f"{value:.4g}"


def _prefixed(value: float) -> str:
    for factor, prefix in _PREFIXES:
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}"
    return f"{value:.3g} "


def markdown(record: dict[str, Any]) -> str:
    """Returns a record as a Markdown table, its notes below."""
    names = columns(record)
    lines = [
        "| " + " | ".join(heading(name) for name in names) + " |",
        "|" + "---|" * len(names),
        *(
            "| " + " | ".join(cell(name, row.get(name)) for name in names) + " |"
            for row in record["rows"]
        ),
    ]
    missing = [f"{name}: {reason}." for name, reason in record["peers"].items() if reason != "ran"]
    note_lines = [f"- {note.removesuffix('.')}." for note in (*missing, *record["notes"])]
    return "\n".join((*lines, *(("", *note_lines) if note_lines else ())))


def title(record: dict[str, Any]) -> str:
    """Returns workload, machine and torch's version in a line."""
    machine = record["machine"]
    sizes = ", quick sizes" if record["quick"] else ""
    return f"{record['workload']}, {machine['name']}, torch {machine['torch']}{sizes}"


def file_name(record: dict[str, Any]) -> str:
    """Returns the file name of a record: one for each workload and machine."""
    name = "".join(c if c.isalnum() else "-" for c in record["machine"]["name"].lower())
    machine = "-".join(part for part in name.split("-") if part)
    return f"{record['workload']}.{machine}{'.quick' if record['quick'] else ''}.json"


def rich_table(record: dict[str, Any]) -> Any:
    """Returns the table that rich prints."""
    from rich.table import Table

    table = Table(title=title(record), title_justify="left")
    names = columns(record)
    for name in names:
        is_text = name in ("case", "who")
        table.add_column(
            heading(name), justify="left" if is_text else "right", overflow="fold", no_wrap=is_text
        )
    for row in record["rows"]:
        table.add_row(*(cell(name, row.get(name)) for name in names))
    return table
