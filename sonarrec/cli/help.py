"""`sonarrec help`: the manual, a page per topic, from sonarrec/help/*.md.

Pages are text for a terminal, and HTML files that can be searched.
"""

from __future__ import annotations

import html
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from string import Template

import click

from sonarrec.cli.endings import headed, say
from sonarrec.cli.groups import FOLDER, command, in_output, names_of
from sonarrec.errors import UsageError

INDEX = "index.html"
_CODE = re.compile(r"`([^`\n]+(?:\n[^`\n]+)?)`")
_ROW = re.compile(r"(\S.*?)  +\S")


def page_texts() -> dict[str, str]:
    """The Markdown of each page by its topic, in the order of names."""
    pages = files("sonarrec").joinpath("help").iterdir()
    texts = {p.name.removesuffix(".md"): p for p in pages if p.name.endswith(".md")}
    return {topic: texts[topic].read_text(encoding="utf-8") for topic in sorted(texts)}


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
        click.echo_via_pager(as_text(by_name[topic], styled=sys.stdout.isatty()))


def title_of(page: str) -> str:
    """What a page tells, by its first line."""
    return page.partition("\n")[0].partition(": ")[2]


def as_text(page: str, *, styled: bool) -> str:
    """A page without the marks of Markdown. styled: headings and code in bold."""
    bold: Callable[[str], str] = headed if styled else str

    def code(match: re.Match[str]) -> str:
        # Without bold, words of a command would run into the sentence around them.
        return bold(match[1]) if styled or " " not in match[1] else f"'{match[1]}'"

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
    found: list[dict[str, str]] = []
    for topic, page in pages.items():
        body, heading, anchor = [], "", ""
        for kind, block in _blocks(page):
            if kind == "heading":
                heading, anchor = block, re.sub(r"\W+", "-", block.lower()).strip("-")
                body.append(f'<h2 id="{anchor}">{_inline(block)}</h2>')
            else:
                body.append(_as_html(kind, block))
            if found and (found[-1]["page"], found[-1]["at"]) == (topic, anchor):
                found[-1]["text"] += " " + " ".join(block.split())
            else:
                found.append({"page": topic, "at": anchor, "head": heading, "text": block})
        title = f"{topic}: {title_of(page)}"
        fields = {"title": html.escape(title), "body": "\n".join(body), "found": "[]"}
        write_page(folder / f"{topic}.html", template.substitute(fields))
    rows = (
        f'<dt><a href="{topic}.html">{topic}</a></dt><dd>{html.escape(title_of(page))}</dd>'
        for topic, page in pages.items()
    )
    body = ["<h1>The manual of sonarrec</h1>", "<dl>", *rows, "</dl>"]
    told = json.dumps(found, ensure_ascii=False).replace("`", "").replace("<", "\\u003c")
    fields = {"title": "all pages", "body": "\n".join(body), "found": told}
    write_page(folder / INDEX, template.substitute(fields))


def _blocks(page: str) -> Iterator[tuple[str, str]]:
    """(kind, text) of what blank lines part: title, heading, code, list, rows or text."""
    lines: list[str] = []
    fenced = False
    for line in [*page.split("\n"), ""]:
        if line.startswith("```") or not (line or fenced):
            if lines:
                yield "code" if fenced else _kind(lines), "\n".join(lines)
            lines, fenced = [], fenced != line.startswith("```")
        elif not fenced and (heading := re.match(r"(##?) (.*)", line)):
            yield ("title" if heading[1] == "#" else "heading"), heading[2]
        else:
            lines.append(line)


def _kind(lines: list[str]) -> str:
    first, *others = lines
    if first.startswith("    "):
        return "code"
    if re.match(r"- |\d+\. ", first):
        return "list"
    is_indented = others and all(line.startswith("    ") for line in others)
    return "rows" if is_indented or _ROW.match(first) else "text"


def _as_html(kind: str, block: str) -> str:
    if kind == "title":
        return f"<h1>{_inline(block)}</h1>"
    if kind == "code":
        lines = block.split("\n")
        indent = min(len(line) - len(line.lstrip()) for line in lines if line.strip())
        return f"<pre>{_inline(chr(10).join(line[indent:] for line in lines))}</pre>"
    if kind == "list":
        number = re.match(r"(\d+)\.", block)
        items = re.split(r"\n?^(?:- |\d+\. )", block, flags=re.MULTILINE)[1:]
        inner = "".join(f"<li>{_inline(' '.join(item.split()))}</li>" for item in items)
        return f'<ol start="{number[1]}">{inner}</ol>' if number else f"<ul>{inner}</ul>"
    if kind == "rows":
        return _rows(block.split("\n"))
    return f"<p>{_inline(block)}</p>"


def _rows(lines: list[str]) -> str:
    """A list of terms and what they mean, which stands beside each or, indented, below it."""
    row = _ROW.match(lines[0])
    column = row.end() - 1 if row else 4
    found: list[tuple[str, list[str]]] = []
    for line in lines:
        beside = line[:column].endswith(" ") or len(line) < column
        if line[0] != " ":
            found.append((line[:column] if row and beside else line, []))
        elif not found:
            return f"<pre>{_inline(chr(10).join(lines))}</pre>"
        if line[0] == " " or (row and beside):
            found[-1][1].append(line[column:] if beside else line)
    inner = (f"<dt>{_inline(a.strip())}</dt><dd>{_inline(' '.join(b))}</dd>" for a, b in found)
    return f"<dl>{''.join(inner)}</dl>"


def _inline(text: str) -> str:
    """Text with its code marked, and links to the pages that it names."""
    marked = _CODE.sub(r"<code>\1</code>", html.escape(text, quote=False))
    known = "|".join(page_texts())
    return re.sub(rf"(sonarrec help\s+)({known})\b", r'\1<a href="\2.html">\2</a>', marked)
