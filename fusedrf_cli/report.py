"""Printing the report of a finished command, a dict: as text for people or as one JSON object."""

import json
import math
from collections.abc import Iterator

import click

from formats.errors import printable
from fusedrf_cli import streams

_UNITS = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))
_LONGEST_LIST = 12


def emit(report: dict, *, as_json: bool, quiet: bool = False) -> None:
    """Print `report` on stdout. With `quiet`, and where stdout is closed, text about an output that was
    written is left out."""
    if as_json:
        click.echo(_escaped(json.dumps(_plain(report), ensure_ascii=False, allow_nan=False)))
    elif not ("output" in report and (quiet or streams.nowhere())):
        for line in lines(report):
            click.echo(printable(line))


def _escaped(text: str) -> str:
    """The same JSON with control characters escaped: strings from hostile files must not move the cursor."""
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)


def lines(report: dict) -> Iterator[str]:
    """The report for people, one fact per line. Warnings are left out: they were printed on stderr."""
    facts = {key: value for key, value in _plain(report, strict=False).items() if key != "warnings"}
    if "output" in facts:
        size = f" ({readable_size(facts.pop('bytes'))})" if "bytes" in facts else ""
        yield f"wrote {facts.pop('output')}{size}"
    yield from _lines(facts, "")


def _lines(facts: dict, indent: str, around: str = "") -> Iterator[str]:
    """around: the keys that the facts stand in."""
    for key, value in facts.items():
        label = f"{indent}{key.replace('_', ' ')}"
        if value in (None, "", [], {}):
            continue
        if _is_table(value):
            yield f"{label}:"
            yield from (f"{indent}  {row}" for row in _table(value))
        elif _are_sentences(value):
            yield f"{label}:"
            yield from (f"{indent}  {sentence}" for sentence in value)
        elif isinstance(value, dict) and any(isinstance(part, dict | list) for part in value.values()):
            yield f"{label}:"
            yield from _lines(value, indent + "  ", f"{around}{key} ")
        else:
            yield f"{label}: {_phrase(around + key, value)}"


def _phrase(key: str, value: object) -> str:
    """One value on one line, with the unit that follows from its `key`."""
    if isinstance(value, dict):
        told = ((name, part) for name, part in value.items() if part is not None)
        return ", ".join(f"{name.replace('_', ' ')} {_phrase(f'{key} {name}', part)}" for name, part in told)
    if isinstance(value, list):
        shown = value if len(value) <= _LONGEST_LIST else value[:_LONGEST_LIST]
        rest = f" and {len(value) - len(shown)} more" if len(shown) < len(value) else ""
        return " ".join(_coordinate(part) or _phrase(key, part) for part in shown) + rest
    if isinstance(value, bool):
        return "yes" if value else "no"
    if "bytes" in key.split(" ") or key.endswith("_bytes"):
        return readable_size(value)
    if isinstance(value, float):
        decibels = "psnr" in key and not key.endswith(("views", "share"))
        unit = " s" if "seconds" in key else " dB" if decibels else ""
        return f"{value + 0.0:.4g}{unit}"  # + 0.0: no "-0"
    return str(value)


def _coordinate(value: object) -> str | None:
    """A number of a list with all its digits where it may be a coordinate of a map grid, of which the first
    four say little."""
    return f"{value:.10g}" if isinstance(value, float) and 1e4 <= abs(value) < 1e8 else None


def readable_size(count: int) -> str:
    """A count of bytes for people, such as 25 MB."""
    for scale, unit in _UNITS:
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count} bytes"


def _is_table(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def _are_sentences(value: object) -> bool:
    """Whether this is a list of notes, which stand on lines of their own."""
    return isinstance(value, list) and bool(value) and all(isinstance(v, str) and " " in v for v in value)


def _table(rows: list[dict]) -> Iterator[str]:
    columns = list(dict.fromkeys(key for row in rows for key, cell in row.items() if cell is not None))
    cells = [[_phrase(key, row[key]) if row.get(key) is not None else "" for key in columns] for row in rows]
    table = [[key.replace("_", " ") for key in columns], *cells]
    widths = [max(len(row[i]) for row in table) for i in range(len(columns))]
    for row in table:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def _plain(value: object, *, strict: bool = True) -> object:
    """`value` in JSON's types: arrays to lists, paths to text and, where `strict`, NaN and inf to null."""
    if isinstance(value, dict):
        return {str(key): _plain(part, strict=strict) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part, strict=strict) for part in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist(), strict=strict)
    if isinstance(value, float):
        return value if math.isfinite(value) or not strict else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)
