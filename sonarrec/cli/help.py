"""`sonarrec help`: the manual, a page per topic, from sonarrec/help/*.md."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from sonarrec.cli.endings import say
from sonarrec.cli.groups import FOLDER, command, in_output, names_of
from sonarrec.cli.manual import INDEX, as_text, page_texts, title_of, write_html
from sonarrec.errors import UsageError


def pages() -> dict[str, str]:
    """Text of each page by its topic; those of commands first, in the order of --help."""
    by_name = page_texts()
    group = click.get_current_context().find_root().command
    commands = [name for name in getattr(group, "commands", {}) if name in by_name]
    return {topic: by_name[topic] for topic in [*commands, *sorted(set(by_name) - set(commands))]}


@command("help", short_help="Show the manual: a page per topic.")
@click.argument("topic", required=False, shell_complete=names_of(page_texts))
@in_output(
    "--html",
    type=FOLDER,
    help="Write all pages into this folder as HTML, with a search box; they need no network.",
)
def help_(topic: str | None, html: Path | None) -> None:
    """Show the page of the manual on TOPIC; without TOPIC list the pages.

    \b
    Examples:
      sonarrec help
      sonarrec help run
      sonarrec help glossary
      sonarrec help --html manual
    """
    by_name = pages()
    if html is not None:
        write_html(html, by_name)
        say(f"{html / INDEX}: {len(by_name)} pages")
    elif topic is None:
        click.echo("sonarrec help TOPIC shows a page. Topics:\n")
        for name, text in by_name.items():
            click.echo(f"  {name:<10} {title_of(text)}")
    elif topic not in by_name:
        raise UsageError(f"help {topic}: there is no such page; the pages are {', '.join(by_name)}")
    else:  # plain where stdout is no terminal
        click.echo_via_pager(as_text(by_name[topic], styled=sys.stdout.isatty()))
