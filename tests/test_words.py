"""What pages and messages are written in: no word that has a better one, and no long message."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "sonarrec" / "help").glob("*.md"))
LONGEST = 200
LONGEST_NOTE = 160
VALUE = "x" * 8  # in place of what a message is filled with
TOLD = {
    *("SonarrecError", "UsageError", "MissingError", "UnusableError", "DamagedError"),
    *("note", "problem", "fault", "print_notes", "inform", "skip"),
}
"""Who says a message to the user: errors, and what takes lines for the terminal."""


def banned() -> list[str]:
    """The words on the left of the table in `sonarrec help method`."""
    page = (ROOT / "sonarrec" / "help" / "method.md").read_text(encoding="utf-8")
    table = page.partition("    not ")[2].partition("\n\n")[0]
    return [line.split("  ")[2].strip() for line in table.splitlines()[1:]]


def texts_of(node: ast.expr) -> list[str]:
    """The texts that an expression may give, with VALUE in place of what is filled in."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else [VALUE]
    if isinstance(node, ast.JoinedStr):
        parts = (v.value if isinstance(v, ast.Constant) else VALUE for v in node.values)
        return ["".join(map(str, parts))]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return [a + b for a in texts_of(node.left) for b in texts_of(node.right)]
    if isinstance(node, ast.IfExp):
        return texts_of(node.body) + texts_of(node.orelse)
    if isinstance(node, ast.List | ast.Tuple):
        return [text for one in node.elts for text in texts_of(one)]
    return [VALUE]


def messages() -> Iterator[tuple[str, str, int]]:
    """(where, text, its most characters) of every message in the code, without an example."""
    for path in sorted((ROOT / "sonarrec").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            told: list[ast.expr] = []
            longest = LONGEST
            if isinstance(node, ast.Call):
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                told = node.args if name in TOLD else []
                longest = LONGEST_NOTE if name == "note" else LONGEST
            elif isinstance(node, ast.Return | ast.Yield) and isinstance(node.value, ast.JoinedStr):
                told = [node.value]  # of functions that say why
            for text in (text for one in told for text in texts_of(one)):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", text.partition("\n")[0], longest


def test_messages_are_short_and_no_text_has_a_word_that_has_a_better_one() -> None:
    """In code such words may be names of settings."""
    found = [*messages()]
    assert len(found) > 400
    assert not [(where, text) for where, text, longest in found if len(text) > longest]
    told = [(where, text) for where, text, _ in found]
    prose = [
        (page.name, re.sub(r"`[^`]*`|^    .*", "", page.read_text("utf-8"), flags=re.MULTILINE))
        for page in [*PAGES, ROOT / "README.md"]
    ]
    word = re.compile(rf"\b({'|'.join(banned())})\b")
    assert not [(where, word.search(text)) for where, text in [*prose, *told] if word.search(text)]
