"""Words and names of pages, messages and code: short, none that has a better one, none of what is
not there."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from sonarrec.cli import main
from sonarrec.config import SECTIONS
from tests.test_docs import COMMANDS, DOCUMENTS, PAGES, README, ROOT, code_lines, examples

MODULES = sorted((ROOT / "sonarrec").rglob("*.py"))
LONGEST = 200
LONGEST_NOTE = 160
LINES = {"README": 115, **dict.fromkeys(("contribute", "formats", "results", "run"), 220)}
"""How long a document may be; the others 150 lines."""
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
    table = (
        PAGES["contribute"]
        .read_text(encoding="utf-8")
        .partition("\n    refused  ")[2]
        .partition("\n\n")[0]
    )
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
        for page in DOCUMENTS
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


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_a_page_is_short_and_fits_a_terminal(document: Path) -> None:
    """It begins with what it is for, and each `sonarrec ...` line of a code block has its `$`."""
    text, name = document.read_text(encoding="utf-8"), document.stem
    assert len(text.splitlines()) <= LINES.get(name, 150)
    assert not [line for line in code_lines(document) if re.match(r"\s*sonarrec [a-z]", line)]
    if document == README:
        return
    assert re.match(rf"# {name}: \S.*\n\n\S", text)
    printed = {line for _, lines in examples(document) for line in lines}
    lines = [line for line in text.splitlines() if line.removeprefix("    ") not in printed]
    assert not [line for line in lines if len(line) > 92]


def test_help_is_short_and_options_are_few() -> None:
    """The ceilings of the last cut; they only fall."""
    counts = {}
    for name, command in COMMANDS.items():
        text = help_of(name)
        assert len(text.splitlines()) <= (110 if name == "run" else 60), name
        counts[name] = sum(isinstance(p, click.Option) for p in command.params)
    assert counts["run"] <= 36
    assert sum(counts.values()) <= 167
    assert sum(len(fields(kind)) for kind in SECTIONS.values()) <= 40


def help_of(name: str) -> str:
    return CliRunner().invoke(main, [*name.split(), "--help"], terminal_width=80).stdout


def test_pages_that_are_named_exist() -> None:
    texts = {document.name: document.read_text(encoding="utf-8") for document in DOCUMENTS}
    for name, text in (texts | {name: help_of(name) for name in COMMANDS}).items():
        for page in re.findall(r"sonarrec help ([a-z]+)|see help\s+([a-z]+)", text):
            assert "".join(page) in PAGES, f"{name}: {page}"


def test_files_and_names_that_the_readme_and_the_page_for_developers_name_exist() -> None:
    text = README.read_text(encoding="utf-8")
    named = re.findall(r"[`(]((?:sonarrec|tests|sample_data)/[\w./]+)[`)#]", text)
    assert len(named) > 5
    text = PAGES["contribute"].read_text(encoding="utf-8").partition("## How to add")[0]
    rows = "\n".join(line for line in text.splitlines() if line.startswith("    "))
    files = re.findall(r"(?<![\w/])((?:[a-z_0-9]+/)*[a-z_0-9]+\.py)\b", rows)
    assert len(files) > 20
    named += [f"sonarrec/{file}" for file in files]
    assert not [path for path in named if not (ROOT / path).exists()]
    rows = rows.partition("cli   ")[0]
    places = re.findall(r"([\w/]+\.py) +([\w.]+(?:, \w+)*)$", rows, re.MULTILINE)
    assert len(places) > 8
    for file, names in places:
        text = (ROOT / "sonarrec" / file).read_text(encoding="utf-8")
        for name in re.split(r"[, .]+", names):
            assert re.search(rf"\b{name}\b", text), f"{file}: {name}"


@pytest.mark.parametrize("command", ["demo", "test"])
def test_the_readme_has_what_each_command_that_installs_needs_and_takes(command: str) -> None:
    text = README.read_text(encoding="utf-8").partition("## Install")[2].partition("\n## ")[0]
    about = text.partition(f"- `make {command}`")[2].partition("\n- ")[0]
    assert re.search(r"\bminutes?\b", about)
    assert re.search(r"[\d.]+ [MG]B", about)
