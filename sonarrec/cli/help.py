"""`sonarrec help`: the manual, a page per topic, from sonarrec/help/*.md.

Pages are text for a terminal, and HTML files that can be searched.
"""

from __future__ import annotations

import html
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from string import Template

import click

from sonarrec.cli.endings import say, styled
from sonarrec.cli.groups import FOLDER, command, in_output, names_of, page_texts
from sonarrec.errors import UsageError

INDEX = "index.html"
_CODE = re.compile(r"`([^`\n]+(?:\n[^`\n]+)?)`")


def pages() -> dict[str, str]:
    """Text of each page by its topic; those of commands first, in the order of --help."""
    by_name = page_texts()
    group = click.get_current_context().find_root().command
    commands = [name for name in getattr(group, "commands", {}) if name in by_name]
    return {topic: by_name[topic] for topic in [*commands, *sorted(set(by_name) - set(commands))]}


@command("help", short_help="Show the manual: a page per topic.")
@click.argument("topic", required=False, shell_complete=names_of(page_texts))
@in_output(
    "--html html_folder",
    type=FOLDER,
    help="Write all pages into this folder as HTML, with a search box; they need no network.",
)
def help_(topic: str | None, html_folder: Path | None) -> None:
    """Show the page of the manual on TOPIC; without TOPIC list the pages.

    \b
    Examples:
      sonarrec help
      sonarrec help run
      sonarrec help glossary
      sonarrec help --html manual
    """
    by_name = pages()
    if html_folder is not None:
        write_html(html_folder, by_name)
        say(f"{html_folder / INDEX}: {len(by_name)} pages")
    elif topic is None:
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


def write_html(folder: Path, pages: Mapping[str, str]) -> None:
    """Write every page as TOPIC.html, and an index that searches all of them.

    Raises UsageError if a file would be overwritten that is not of an earlier call, SonarrecError
    if one cannot be written.
    """
    from sonarrec.tables.outputs import check_output, write_page

    for name in (INDEX, *(f"{topic}.html" for topic in pages)):
        check_output(folder / name, "manual")
    template = Template(files("sonarrec").joinpath("help", "page.html").read_text("utf-8"))
    links = re.compile(rf"(sonarrec help\s+)({'|'.join(pages)})\b")

    def marked(text: str) -> str:
        """Text with its code marked, and links to the pages that it names."""
        plain = re.sub("^```.*\n?", "", html.escape(text, quote=False), flags=re.MULTILINE)
        code = _CODE.sub(r"<code>\1</code>", plain)
        return links.sub(r'\1<a href="\2.html">\2</a>', code)

    def write(name: str, title: str, body: list[str], found: Sequence[object] = ()) -> None:
        told = json.dumps(found, ensure_ascii=False).replace("<", "\\u003c")
        fields = {"title": html.escape(title), "body": "\n".join(body), "found": told}
        write_page(folder / name, template.substitute(fields))

    found, rows = list[dict[str, str]](), list[str]()
    for topic, page in pages.items():
        title, body = f"{topic}: {title_of(page)}", list[str]()
        for section in page.removeprefix("# ").split("\n## "):
            heading, _, text = section.partition("\n")
            anchor = re.sub(r"\W+", "-", heading.lower()).strip("-") if body else ""
            level = f'h2 id="{anchor}"' if body else "h1"
            body.append(f"<{level}>{marked(heading)}</{level[:2]}>")
            body.append(f"<pre>{marked(text.strip(chr(10)))}</pre>")
            words = " ".join(text.replace("`", "").split())
            head = heading if anchor else ""
            found.append({"page": topic, "at": anchor, "head": head, "text": words})
        write(f"{topic}.html", title, body)
        rows.append(f'<dt><a href="{topic}.html">{topic}</a></dt><dd>{marked(title_of(page))}</dd>')
    body = ["<h1>The manual of sonarrec</h1>", "<dl>", *rows, "</dl>"]
    write(INDEX, "all pages", body, found)
