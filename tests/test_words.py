"""Words of pages, messages and code: none that has a better one. And no message is too long."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "sonarrec" / "help").glob("*.md"))
MODULES = sorted((ROOT / "sonarrec").rglob("*.py"))
LONGEST = 200
LONGEST_NOTE = 160
VALUE = "x" * 8  # in place of what a message is filled with
TOLD = {
    *("SonarrecError", "UsageError", "MissingError", "UnusableError", "DamagedError"),
    *("note", "problem", "fault", "print_notes", "inform", "skip"),
}
"""Calls whose arguments are shown to the user: errors, notes, and lines for the terminal."""

REFUSED = {
    "turn turns turned": "rotation, rotated; yaw of a vehicle, shift of a pan",
    "place places": "position, pixel, index; of files: path, folder",
    "away": "distance, offset",
    "beside": "neighbours, adjacent; of files: sibling",
    "alike": "similar, equal; correlation",
    "apart": "separation, distinct",
    "anew": "again, new",
    "tell tells told": "report, diagnostics, notes, lines",
    "put puts": "send, write, set",
    "take takes taken taking": "read, receive, select, used",
    "look looks looked": "view, frames, inspect, appearance; style of a plot",
    "laid": "composite, layout",
    "unlike": "differing, other",
    "thing things": "object, objects",
    "begun": "started",
    "served": "shown",
    "settled": "rounded, fixed, converged",
    "earned": "enough_evidence",
    "enlarge enlarged": "upsample, upsampled",
    "shrink shrunk": "downsample, downsampled, reduced",
    "whole": "complete, full, contiguous; integer of numbers",
    "carry carried": "apply_motion, moved, predicted",
    "pull pulled": "moved_off_prediction; strength of a prior",
    "strike strikes": "count_misses, misses",
    "shows": "visible_share, visible",
    "born": "new",
    "forget forgot forgotten": "drop, dropped",
}
"""Parts of names that code must not have, and what is used in place of them."""
KEYS = {
    "config": {"strikes", "count_strikes"},
    "run_file": {"place"},
    "scene": {"turned_deg"},
    "model": {"at"},
}
"""By module, fields that may have such names, since they are keys of files that users have."""
VAGUE_NAMES = {"of", "one", "found", "mine", "theirs", "there", "here"}
"""Names that say of no value what it is: a log, a row, a folder, a match."""
MOST_VAGUE_NAMES = 5
"""How many may be left: four methods `of`, and the module of runs of one log."""
VAGUE = re.compile(r"\b(told|beside|apart|away|alike|turned|places|anew)\b", re.IGNORECASE)
MOST_VAGUE = 8
"""The number of VAGUE words that comments, docstrings and messages may have in all."""


def banned() -> list[str]:
    """The regular expressions on the left of the table in `sonarrec help contribute`."""
    page = (ROOT / "sonarrec" / "help" / "contribute.md").read_text(encoding="utf-8")
    table = page.partition("\n    refused  ")[2].partition("\n\n")[0]
    return [line.strip().partition("  ")[0] for line in table.splitlines()[1:]]


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


@cache
def nodes(module: Path) -> tuple[ast.AST, ...]:
    """All nodes of its syntax tree."""
    return tuple(ast.walk(ast.parse(module.read_text(encoding="utf-8"))))


def messages() -> Iterator[tuple[str, str, int]]:
    """(where, first line, most characters) of every message in the code.

    The lines that follow the first one are examples, which may be long.
    """
    for path in MODULES:
        for node in nodes(path):
            said: list[ast.expr] = []
            longest = LONGEST
            if isinstance(node, ast.Call):
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                said = node.args if name in TOLD else []
                longest = LONGEST_NOTE if name == "note" else LONGEST
            elif isinstance(node, ast.Return | ast.Yield) and isinstance(node.value, ast.JoinedStr):
                said = [node.value]  # of functions that say why
            for text in (text for expression in said for text in texts_of(expression)):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", text.partition("\n")[0], longest


def test_messages_are_short_and_no_text_has_a_word_that_has_a_better_one() -> None:
    """In pages, text in backticks and indented lines are not checked: they may name settings."""
    found = [*messages()]
    assert len(found) > 400
    assert not [(where, text) for where, text, longest in found if len(text) > longest]
    said = [(where, text) for where, text, _ in found]
    prose = [
        (page.name, re.sub(r"`[^`]*`|^    .*", "", page.read_text("utf-8"), flags=re.MULTILINE))
        for page in [*PAGES, ROOT / "README.md"]
    ]
    word = re.compile(rf"\b({'|'.join(banned())})\b")
    assert not [(where, word.search(text)) for where, text in [*prose, *said] if word.search(text)]


def names_in(path: Path) -> Iterator[tuple[str, int]]:
    """(name, line) of all that a module defines, and its own name; no uses, no keys of files."""
    yield path.stem, 1
    keys = {
        field.target
        for node in nodes(path)
        if isinstance(node, ast.ClassDef)
        for field in node.body
        if isinstance(field, ast.AnnAssign)
        and getattr(field.target, "id", "") in KEYS.get(path.stem, ())
    }
    for node in nodes(path):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            if node not in keys:
                yield getattr(node, "id", getattr(node, "attr", "")), node.lineno
        elif isinstance(node, ast.alias | ast.ExceptHandler):
            name = node.asname if isinstance(node, ast.alias) else node.name
            yield name or "", node.lineno


def test_names_use_words_of_the_field_and_vague_ones_are_rare() -> None:
    """Every part of each name, also of those in capitals: `sight_turned`, `TURNED_DEG`."""
    better = {word: use for words, use in REFUSED.items() for word in words.split()}
    refused, vague = [], []
    for path in MODULES:
        for name, line in names_in(path):
            where = f"{path.relative_to(ROOT)}:{line}: {name}"
            parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().split("_")
            bad = [part for part in parts if part in better]
            bad += ["at"] * (name.strip("_") == "at")
            refused += [f"{where}: use {better.get(part, 'index, position')}" for part in bad]
            vague += [where] if name in VAGUE_NAMES else []
    assert not refused, "\n".join(refused)
    assert len(vague) <= MOST_VAGUE_NAMES, "\n".join(vague)


def test_vague_words_are_rare() -> None:
    found = []
    for path in MODULES:
        if not VAGUE.search(path.read_text(encoding="utf-8")):
            continue
        with tokenize.open(path) as file:
            for token in tokenize.generate_tokens(file.readline):
                kind = tokenize.tok_name[token.type]
                if kind in ("COMMENT", "STRING", "FSTRING_MIDDLE"):
                    where = f"{path.relative_to(ROOT)}:{token.start[0]}"
                    found += [f"{where}: {word}" for word in VAGUE.findall(token.string)]
    assert len(found) <= MOST_VAGUE, "\n".join(found)
