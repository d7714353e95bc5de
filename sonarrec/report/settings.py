"""The tables of settings on the page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


def settings_tables(
    table: Mapping[str, Any], name: str = "run"
) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """run.toml as (table name, its keys and values); nested tables follow."""
    plain = {key: value for key, value in table.items() if not _is_nested(value)}
    if plain:
        yield name, [(key, _plain(value)) for key, value in plain.items()]
    for key, value in table.items():
        if _is_nested(value):
            label = key if name == "run" else f"{name}.{key}"
            for n, part in enumerate(value if isinstance(value, list) else [value]):
                yield from settings_tables(
                    part, f"{label}[{n}]" if isinstance(value, list) else label
                )


def _is_nested(value: Any) -> bool:
    """Whether a TOML value is a table, or several that hold tables."""
    if isinstance(value, list):
        return any(isinstance(part, dict) and any(map(_is_nested, part.values())) for part in value)
    return isinstance(value, dict)


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(v)}" for key, v in value.items())
    if isinstance(value, list):
        between = "; " if any(isinstance(v, dict) for v in value) else ", "
        return between.join(map(_plain, value)) or "none"
    return str(value).lower() if isinstance(value, bool) else str(value)
