"""Building blocks of commands: groups of options in --help, combined options, path types."""

from __future__ import annotations

import math
import os
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial, wraps
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from sonarrec.errors import QUOTES, UsageError, plain_number, refuse_url, similar_name

FIRST = "Most used"
GROUPS = ("Input", "Scoring", "Settings", "Geometry", "Many logs", "Output")
"""Of --help, in this order."""
_DASHES = "\u2010\u2011\u2012\u2013\u2014\u2212"
_TYPED = str.maketrans(dict.fromkeys(_DASHES, "-") | dict.fromkeys(QUOTES, "'") | {"\xa0": " "})
_PASTED = re.compile(rf"-*([{_DASHES}])|(?:.*=)?([{QUOTES}])|.*([{QUOTES}])$|.*(\xa0)")
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def page_texts() -> dict[str, str]:
    """The Markdown of each page of the manual by its topic, in the order of names."""
    from sonarrec.results.columns import with_columns

    pages = sorted(files("sonarrec").joinpath("help").iterdir(), key=lambda page: page.name)
    return {p.name[:-3]: with_columns(p.read_text("utf-8")) for p in pages if p.name[-3:] == ".md"}


def advice_on(word: str) -> str:
    """What `help changes` says of an option or a command that is gone; empty if it says nothing."""
    for version in page_texts()["changes"].split("\n## ")[1:]:
        for item in version.partition("\nGone\n")[2].split("\n- "):
            named = re.sub(r"\(.*?\)", "", item.partition(":")[0], flags=re.DOTALL)
            if word in {w for code in re.findall("`(.*?)`", named) for w in code.split()}:
                return f"Gone: {' '.join(item.removeprefix('- ').split())}"
    return ""


def refuse_typography(words: Iterable[str], known: Collection[str]) -> None:
    """Raise UsageError for a word with a dash, quotes or a space of a word processor.

    Names of files that are there may have them. known: options.
    """
    for word in words:
        if (pasted := _PASTED.match(word)) and not os.path.lexists(word):
            mark = unicodedata.name(next(filter(None, pasted.groups()))).lower()
            plain = word.translate(_TYPED)
            plain = f"-{plain}" if f"-{plain.partition('=')[0]}" in known else plain
            raise UsageError(
                f"{word}: holds the {mark} of a word processor, which the shell does not know; "
                f"type {plain}"
            )


def _readable(value: Any) -> Any:
    """The name of a file to read; URLs and pipes are refused."""
    from sonarrec.tables import refuse_pipe

    refuse_pipe(Path(refuse_url(value)))
    return value


class _Local(click.Path):
    """A local path; URLs are refused, as they would create a local folder `s3:`."""

    def convert(self, value: Any, *context: Any) -> Any:
        name = _readable(value) if self.exists else refuse_url(value)
        try:
            return super().convert(name, *context)
        except click.BadParameter as error:
            if Path(name).exists():
                raise
            self.fail(f"{error.message.removesuffix('.')}{similar_name(Path(name))}", *context)


class ListFile(click.File):
    """A text to read; else as FILE."""

    def convert(self, value: Any, *context: Any) -> Any:
        return super().convert(_readable(value), *context)


FILE = _Local(exists=True, dir_okay=False, path_type=Path)
EXISTING = _Local(exists=True, path_type=Path)
NEW_FILE = _Local(dir_okay=False, path_type=Path)
FOLDER = _Local(file_okay=False, path_type=Path)
ANY = _Local(path_type=Path)


class Number(click.types.FloatParamType):
    """A number; of another text the fault says how to write it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is not a number{plain_number(value)}", param, ctx)


class FiniteRange(click.FloatRange):
    """A number within bounds. nan is refused, which no bound shuts out, and infinity."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        value = NUMBER.convert(value, param, ctx)
        if not math.isfinite(float(number := super().convert(value, param, ctx))):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


class IntegerRange(click.IntRange):
    """A whole number within bounds."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            int(value)
        except ValueError:
            self.fail(f"{value!r} is not a whole number; write one, such as 2", param, ctx)
        return super().convert(value, param, ctx)


NUMBER = Number()


class GroupedOption(click.Option):
    """An option that belongs to a group of --help."""

    def __init__(self, *names: Any, group: str, **options: Any) -> None:
        super().__init__(*names, **options)
        self.group = group


class GroupedCommand(click.Command):
    """A command whose --help shows its options in groups and names its help page."""

    def __init__(self, *arguments: Any, first: Collection[str] = (), **options: Any) -> None:
        """first: options that --help shows before all groups, by one of their names."""
        super().__init__(*arguments, **options)
        self.first = first

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Raise UsageError for an empty argument, which as a path would mean the current folder."""
        for before, word in pairwise([ctx.info_name, *args]):
            option, is_set, value = str(word).partition("=")
            if not word or (option.startswith("--") and is_set and not value):
                raise UsageError(f"empty argument after {option or before}; is a variable unset?")
        known = {name for param in self.params for name in param.opts}
        refuse_typography(args, known)
        single = [f"-{word}" for word in args if f"-{word.partition('=')[0]}" in known]
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            advice = f"Did you mean {single[0]}?" if single else advice_on(error.option_name)
            if not advice:
                raise
            message = f"{error.message} {advice}"
            raise click.NoSuchOption(error.option_name, message, ctx=ctx) from None
        except click.UsageError as error:
            if "extra argument" not in error.message:
                raise
            given = {p.name: p.opts[0] for p in self.params if isinstance(p, click.Option)}
            words = {"ground_truth": "a ground truth is", "results": "results are"}
            how = [f", {words[name]} given with {given[name]}" for name in words if name in given]
            message = f"{error.message}; a name with spaces needs quotes{''.join(how)}"
            raise click.UsageError(message, ctx) from None

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows: dict[str, list[tuple[str, str]]] = {g: [] for g in (FIRST, *GROUPS, "Other")}
        for parameter in self.get_params(ctx):
            row = parameter.get_help_record(ctx)
            if row is not None and isinstance(parameter, click.Option):
                is_first = not set(parameter.opts).isdisjoint(self.first)
                rows[FIRST if is_first else getattr(parameter, "group", "Other")].append(row)
        for group, records in rows.items():
            if records:
                with formatter.section(group):
                    formatter.write_dl(records)
        page = ctx.command_path.removeprefix(ctx.find_root().command_path).split()[0]
        formatter.write_paragraph()
        formatter.write_text(f"More: sonarrec help {page}".removesuffix(" help"))


command = partial(click.command, cls=GroupedCommand)


def _option(group: str, names: str, **options: Any) -> Decorator:
    return click.option(*names.split(), cls=GroupedOption, group=group, **options)


# `click.option` in a group of --help; its names stand in one text.
in_input, in_scoring, in_settings, in_geometry, in_batch, in_output = (
    partial(_option, group) for group in GROUPS
)


def as_one(
    argument: str, options: Mapping[str, Decorator], make: Callable[[dict[str, Any]], Any]
) -> Decorator:
    """Add options whose values `make` turns into the one argument `argument` of the command."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def gather(**arguments: Any) -> Any:
            values = {key: arguments.pop(key) for key in options}
            return function(**arguments, **{argument: make(values)})

        called: Callable[..., Any] = gather
        for add in reversed([*options.values()]):
            called = add(called)
        return called

    return decorate


# `shell_complete` of an option or argument


def file_names(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Of a text that may be a path."""
    return [CompletionItem(incomplete, type="file")]
