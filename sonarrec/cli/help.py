"""`sonarrec help`: the manual, a page per topic, from sonarrec/help/*.md."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import partial

import click

from sonarrec.cli.endings import styled
from sonarrec.cli.groups import command, page_texts
from sonarrec.errors import UsageError

_CODE = re.compile(r"`([^`\n]+(?:\n[^`\n]+)?)`")


def pages() -> dict[str, str]:
    """Text of each page by its topic; those of commands first, in the order of --help."""
    by_name = page_texts()
    group = click.get_current_context().find_root().command
    commands = [name for name in getattr(group, "commands", {}) if name in by_name]
    return {topic: by_name[topic] for topic in [*commands, *sorted(set(by_name) - set(commands))]}


@command("help", short_help="Show the manual: a page per topic.")
@click.argument("topic", required=False)
def help_(topic: str | None) -> None:
    """Show the page of the manual on TOPIC; without TOPIC list the pages.

    \b
    Examples:
      sonarrec help
      sonarrec help run
      sonarrec help glossary
    """
    by_name = pages()
    if topic is None:
        click.echo("sonarrec help TOPIC shows a page. Topics:\n")
        for name, text in by_name.items():
            click.echo(f"  {name:<10} {title_of(text)}")
    elif topic not in by_name:
        raise UsageError(f"help {topic}: there is no such page; the pages are {', '.join(by_name)}")
    else:  # plain where stdout is no terminal
        click.echo_via_pager(as_text(by_name[topic], marked=sys.stdout.isatty()))


def title_of(page: str) -> str:
    """What a page tells, by its first line."""
    return page.partition("\n")[0].partition(": ")[2]


def as_text(page: str, *, marked: bool) -> str:
    """A page without the marks of Markdown. marked: headings and code in bold."""
    bold: Callable[[str], str] = partial(styled, bold=True) if marked else str

    def code(match: re.Match[str]) -> str:
        # Without bold, words of a command would run into the sentence around them.
        return bold(match[1]) if marked or " " not in match[1] else f"'{match[1]}'"

    lines, fenced = list[str](), False
    for line in page.rstrip("\n").split("\n"):
        if line.startswith("```"):
            fenced = not fenced
        elif heading := not fenced and re.match(r"#+ (.*)", line):
            lines.append(bold(heading[1]))
        else:
            lines.append(f"    {line}" if fenced and line else line)
    return _CODE.sub(code, "\n".join(lines))
