"""`sonarrec help`: the manual, a page per topic, from sonarrec/help/*.md."""

from __future__ import annotations

import re
import sys
from importlib.resources import files

import click

from sonarrec.cli.endings import headed
from sonarrec.cli.groups import command, names_of
from sonarrec.errors import UsageError


def _topics() -> list[str]:
    names = (page.name for page in files("sonarrec").joinpath("help").iterdir())
    return sorted(name.removesuffix(".md") for name in names if name.endswith(".md"))


def pages() -> dict[str, str]:
    """Text of each page by its topic; those of commands first, in the order of --help."""
    by_name = {
        page.name.removesuffix(".md"): page.read_text(encoding="utf-8")
        for page in files("sonarrec").joinpath("help").iterdir()
        if page.name.endswith(".md")
    }
    group = click.get_current_context().find_root().command
    commands = [name for name in getattr(group, "commands", {}) if name in by_name]
    return {topic: by_name[topic] for topic in [*commands, *sorted(set(by_name) - set(commands))]}


@command("help", short_help="Show the manual: a page per topic.")
@click.argument("topic", required=False, shell_complete=names_of(_topics))
def help_(topic: str | None) -> None:
    """Show the page of the manual on TOPIC; without TOPIC list the pages.

    \b
    Examples:
      sonarrec help
      sonarrec help run
      sonarrec help results | less
    """
    by_name = pages()
    if topic is None:
        click.echo("sonarrec help TOPIC shows a page. Topics:\n")
        for name, text in by_name.items():
            title = text.partition("\n")[0].partition(": ")[2]
            click.echo(f"  {name:<10} {title}")
    elif topic not in by_name:
        raise UsageError(f"help {topic}: there is no such page; the pages are {', '.join(by_name)}")
    else:
        text = by_name[topic].rstrip("\n")
        if sys.stdout.isatty():
            text = re.sub(r"^#+ (.*)", lambda heading: headed(heading[1]), text, flags=re.MULTILINE)
        click.echo_via_pager(text)  # plain where stdout is no terminal
