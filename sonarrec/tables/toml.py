"""Reads TOML, and turns its tables into dataclasses.

A dataclass defines what its table may hold; the types of its fields carry bounds (msgspec.Meta).
An error is one line that names the file, the key, the bound and the value.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import re
import reprlib
import sys
import tomllib
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from sonarrec.errors import QUOTES, SonarrecError, plain_number, redact_urls
from sonarrec.tables import not_text

MAX_LENGTH = 2**24
"""Bytes; a longer file cannot hold settings."""
MAX_DEPTH = 32
"""Levels of nested tables and lists."""

_MOST = sys.float_info.max


def bounds(least: float, most: float = _MOST) -> msgspec.Meta:
    """Bounds of a number, inclusive; NaN and infinity are never allowed."""
    return msgspec.Meta(ge=least, le=most)


def length(least: int, most: int) -> msgspec.Meta:
    """Bounds of the length of a list, inclusive."""
    return msgspec.Meta(min_length=least, max_length=most)


Finite = Annotated[float, bounds(-_MOST)]
Positive = Annotated[float, msgspec.Meta(gt=0, le=_MOST)]
NotNegative = Annotated[float, bounds(0)]
Share = Annotated[float, bounds(0, 1)]
Integer = Annotated[int, bounds(-(2**63), 2**63 - 1)]  # the range that TOML requires
Count = Annotated[int, bounds(0, 2**63 - 1)]
AtLeastOne = Annotated[int, bounds(1, 2**63 - 1)]


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a file. Raises SonarrecError if it cannot be read or is not TOML."""
    return parse_toml(read_text(path), str(path))


def read_text(path: Path) -> str:
    """The text of a TOML file. Raises SonarrecError if it cannot be read."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_LENGTH + 1)
        if what := not_text(content[:32], "a TOML file"):
            raise SonarrecError(f"{path}: {what}")
        if len(content) > MAX_LENGTH:
            raise SonarrecError(
                f"{path}: not a readable TOML file, it is larger than {MAX_LENGTH >> 20} MiB"
            )
        text = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig").read()
    except (OSError, UnicodeDecodeError) as fault:
        how = "; save it as UTF-8" if isinstance(fault, UnicodeDecodeError) else ""
        raise SonarrecError(
            f"{path}: not a readable TOML file, it cannot be read ({fault}){how}"
        ) from None
    return text


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text. where: names it in errors (SonarrecError, if it is not TOML)."""
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as fault:  # also of Python's own limit on digits
        how = _how_to_write(text, str(fault))
        raise SonarrecError(f"{where}: not a readable TOML file ({fault}){how}") from None
    if why := _beyond_toml(table):
        raise SonarrecError(f"{where}: not a readable TOML file ({why})")
    return table


_OPTION_OF = {
    "sonar": "--sonar",
    "landmark": "--landmarks",
    "reader": "--model",
    "log": "`sonarrec check`",
    **dict.fromkeys(("candidates", "continuity", "features", "smi"), "--config"),
}
"""Of keys of one kind of file the option that takes it."""


def _how_to_write(text: str, fault: str) -> str:
    """What is usually meant where a text is not TOML; empty: not known."""
    if "overwrite" in fault:
        return "; a key stands there twice: delete one"
    if "Unescaped" in fault or "Invalid hex" in fault:
        return "; write / in place of \\ in paths"
    first = text.partition("\n")[0]
    if "," in first and "=" not in first:
        return "; it seems to be a CSV table: give a TOML file"
    number = re.search(r"\(at line (\d+),", fault)
    line = "".join(text.splitlines()[int(number[1]) - 1 : int(number[1])] if number else [])
    for form, how in _SLIPS:
        if match := re.match(form, line, re.IGNORECASE):
            parts = {name: part for name, part in match.groupdict().items() if part}
            return f"; {how.format(**parts, small=parts.get('value', '').lower())}"
    return ""


_KEY = r"\s*(?P<key>[\w.-]+)\s*"
_SLIPS = (
    (rf"{_KEY}=[\s\[]*[{QUOTES}]", 'write straight quotes (") in place of typographic ones'),
    (rf"{_KEY}=\s*[-+]?[0-9]+,[0-9]", "decimals have a point"),
    (rf"{_KEY}=\s*(?P<value>true|false)\s*(#.*)?$", "write {key} = {small}, in small letters"),
    (rf"{_KEY}=\s*(?:yes|no|on|off)\s*(#.*)?$", "write {key} = true or {key} = false"),
    (rf"{_KEY}=\s*(?:none|null|nan|n/a)?\s*(#.*)?$", "where there is no value, delete the line"),
    (rf"{_KEY}=\s*(?P<value>[-+]?\.[0-9]+)", "a digit stands before the point: 0.3, not .3"),
    (rf"{_KEY}=\s*[-+]?[0-9.]+\s*[^\W\d_]", "numbers have no unit: the name of the key has it"),
    (
        rf"{_KEY}=\s*(?P<value>[^\W\d_][^\"'#\[\]{{}}=]*?)\s*(#.*)?$",
        'text wants quotes: {key} = "{value}"',
    ),
    (rf"{_KEY}=\s*\(", "lists have square brackets: [1, 2]"),
    (rf"{_KEY}:", "write {key} = VALUE, with an equals sign"),
    (r"\s*(?://|;|--|/\*)", "comments begin with #"),
)
"""What is usually meant by a line that is not TOML, by its form."""


def _beyond_toml(value: Any, depth: int = 0) -> str:
    """What is beyond the limits of TOML; "" if nothing is. Without such values a table is safe to
    print, to convert to floats and to traverse."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return "a whole number of more than 64 bits"
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if parts and depth == MAX_DEPTH:
        return "tables or lists nested too deep"
    return next(filter(None, (_beyond_toml(part, depth + 1) for part in parts)), "")


def named_file(source: str | Path, built_in: Path) -> Path | None:
    """The TOML file of the name `source` in the folder `built_in`, else the file `source`, else
    None."""
    for path in (built_in / f"{source}.toml", Path(source)):
        try:
            if path.is_file():
                return path
        except OSError:  # a name too long for the file system
            continue
    return None


T = TypeVar("T")


def from_table(
    kind: type[T], table: object, where: str, *, section: str = "", over: T | None = None
) -> T:
    """The dataclass `kind` from a TOML table; fields that are dataclasses from its sub-tables.

    where, section: name the table in errors. over: gives the values of missing keys, in place of
    the defaults. A field's metadata may have a "key", its name in the file.
    Raises SonarrecError for unknown and missing keys and for values of a wrong type or out of
    bounds.
    """
    name_of_table = f"{where}: [{section}]" if section else where
    if not isinstance(table, Mapping):
        raise SonarrecError(f"{name_of_table} must be a table of keys, not {brief(table)}")
    types = types_of(kind)  # type: ignore[arg-type]
    names = {f.metadata.get("key", f.name): f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    inside = f" in [{section}]" if section else ""
    values: dict[str, Any] = {}
    for key, value in table.items():
        label = f"{section}.{_key(key)}" if section else _key(key)
        if key not in names:
            listed = f"; known{inside or ' keys'}: {', '.join(names)}"
            if not section and key in _OPTION_OF:
                listed = f", which belongs to a file for {_OPTION_OF[key]}{listed}"
            raise SonarrecError(f"{where}: unknown key {label}{_meant(str(key), names) or listed}")
        name = names[key].name
        wanted: Any = types[name]
        rows: Any = get_args(wanted)[0] if get_origin(wanted) is tuple else None
        if _has_keys(wanted):
            part = None if over is None else getattr(over, name)
            if not isinstance(value, wanted):
                value = from_table(wanted, value, where, section=label, over=part)
        elif _has_keys(rows):
            if not isinstance(value, list | tuple):
                raise SonarrecError(f"{where}: write each {label} under its own [[{label}]]")
            value = tuple(
                from_table(rows, row, f"{where}: [[{label}]] {n}") for n, row in enumerate(value, 1)
            )
        else:
            value = checked(value, wanted, f"{where}: {label}")
        values[name] = value
    if over is not None:
        return dataclasses.replace(over, **values)  # type: ignore[type-var]
    needed = (dataclasses.MISSING, dataclasses.MISSING)
    lacks = [
        key
        for key, f in names.items()
        if f.name not in values and (f.default, f.default_factory) == needed
    ]
    if lacks:
        raise SonarrecError(f"{name_of_table} lacks {', '.join(lacks)}")
    return kind(**values)


def _meant(key: str, names: Iterable[str]) -> str:
    """The name that is most like a key, whatever the order of its words; "" if none is."""
    by_words = {"_".join(sorted(name.split("_"))): name for name in names}
    near = get_close_matches("_".join(sorted(key.split("_"))), by_words, 1)
    return f" (did you mean {by_words[near[0]]}?)" if near else ""


def checked(value: object, wanted: Any, label: str) -> Any:
    """`value` as the type `wanted`. Raises SonarrecError, which begins with `label`, if it is
    invalid."""
    is_integer = _bare(wanted)[0] is int and isinstance(value, float) and value.is_integer()
    try:  # 1e3 is a whole number too
        return msgspec.convert(int(value) if is_integer else value, wanted)  # type: ignore[call-overload]
    except msgspec.ValidationError:
        how = (
            plain_number(value) if isinstance(value, str) and "number" in described(wanted) else ""
        )
        raise SonarrecError(
            f"{label} must be {described(wanted)}, not {brief(value)}{how}"
        ) from None


@functools.cache
def types_of(kind: Any) -> dict[str, Any]:
    """The fields' types with their bounds, by name; X for `X | None`, since TOML has no None."""

    def without_none(hint: Any) -> Any:
        if get_origin(hint) in (Annotated, tuple, dict, Literal):
            return hint
        return next((a for a in get_args(hint) if a is not NoneType), hint)

    hints = get_type_hints(kind, include_extras=True)
    return {name: without_none(hint) for name, hint in hints.items()}


def _has_keys(wanted: Any) -> bool:
    return dataclasses.is_dataclass(wanted)


def _bare(wanted: Any) -> tuple[Any, tuple[msgspec.Meta, ...]]:
    """(a type without its annotations, the annotations)."""
    if get_origin(wanted) is not Annotated:
        return wanted, ()
    bare, *metas = get_args(wanted)
    return bare, tuple(metas)


def choices(wanted: Any) -> tuple[Any, ...]:
    """The values of a Literal type, else ()."""
    bare, _ = _bare(wanted)
    return get_args(bare) if get_origin(bare) is Literal else ()


def described(wanted: Any) -> str:
    """A type in words, such as "a number from 0 to 1"."""
    bare, metas = _bare(wanted)
    if few := [f'"{c}"' if isinstance(c, str) else str(c) for c in choices(wanted)]:
        return " or ".join(filter(None, (", ".join(few[:-1]), few[-1])))
    if get_origin(bare) is tuple:
        each, *more = get_args(bare)
        count = f" of {1 + len(more)}" if Ellipsis not in more else ""
        for meta in metas:
            count = f" of {meta.min_length} to {meta.max_length}"
        return f"a list{count}, each {described(each)}"
    if isinstance(bare, UnionType):
        return " or ".join(described(each) for each in get_args(bare))
    words = {
        str: "a text",
        bool: "true or false",
        dict: "a table of keys",
        list: "a list of tables",
    }
    if (kind := get_origin(bare) or bare) in words:
        return words[kind]
    noun = "a whole number" if bare is int else "a number"
    least = most = beyond = ""
    for meta in metas:
        if meta.gt is not None:
            beyond = f" above {meta.gt:g}"
        if meta.ge is not None and meta.ge > -(2**63):
            least = f"{meta.ge:g}"
        if meta.le is not None and meta.le < 2**63 - 1:
            most = f"{meta.le:g}"
    if least:
        return f"{noun} from {least} to {most}" if most else f"{noun}, {least} or more"
    return noun + beyond if beyond or bare is int else "a finite number"


_short = reprlib.Repr()
_short.maxlevel, _short.maxdict, _short.maxstring, _short.maxother = 2, 3, 60, 60


def brief(value: object) -> str:
    """A value for a message: on one line, at most about 60 characters."""
    return _short.repr(redact_urls(value) if isinstance(value, str) else value)


def _key(key: str) -> str:
    """A key for a message, quoted if TOML requires it."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]{1,60}", key) else brief(key)
