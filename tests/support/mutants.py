"""`make mutants`: changes the package at random, one place at a time, and runs the tests on it.

A mutant that no test notices shows what the tests do not assert. Which tests cover a line, and how
long each takes, is measured once and kept in build/mutants; delete that folder to measure again.
The package is changed in a copy, never here.
"""

from __future__ import annotations

import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import click
import pytest
from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "build" / "mutants"
NO_TESTS = 5  # exit code of pytest
ORDER, SECONDS = "MUTANTS_ORDER", "MUTANTS_SECONDS"  # files that this module reads as a plugin
COMPARISONS = {ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt}
COMPARISONS |= {ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is}
COMPARISONS |= {ast.In: ast.NotIn, ast.NotIn: ast.In}
ARITHMETIC = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
ARITHMETIC |= {ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult}


class Mutant(NamedTuple):
    """One change of the package. file: below ROOT. start, end: (line from 1, byte from 0)."""

    file: str
    start: tuple[int, int]
    end: tuple[int, int]
    text: str
    is_global: bool
    """Whether its line is run as the module is imported, by no test in particular."""


def mutants_of(node: ast.AST) -> Iterator[tuple[str, str]]:
    """(kind, new text) of the changes of one node."""
    match node:
        case ast.Compare(left, [op], [right]):
            yield "comparison", ast.unparse(ast.Compare(left, [COMPARISONS[type(op)]()], [right]))
        case ast.BinOp(left, op, right) if type(op) in ARITHMETIC:
            texts = (ast.JoinedStr, ast.List, ast.Tuple)
            if not any(isinstance(x, texts) or _is_text(x) for x in (left, right)):
                yield (
                    "arithmetic",
                    f"({ast.unparse(ast.BinOp(left, ARITHMETIC[type(op)](), right))})",
                )
        case ast.Constant(bool(value)):
            yield "boolean", str(not value)
        case ast.Constant(int(value) | float(value)):
            yield "constant", repr(value * 2 if value and type(value) is int else value * 1.3 or 1)
        case ast.BoolOp(op, values):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield "boolean", f"({ast.unparse(ast.BoolOp(other, values))})"
        case ast.UnaryOp(ast.Not(), operand):
            yield "boolean", f"bool({ast.unparse(operand)})"
        case ast.Return(value) if value is not None:
            yield "return", "return None"
        case ast.Call(func, [first, second, *rest], keywords):
            same = ast.unparse(first) == ast.unparse(second)
            if not same and not isinstance(first, ast.Starred) | isinstance(second, ast.Starred):
                yield "order", ast.unparse(ast.Call(func, [second, first, *rest], keywords))


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def all_mutants() -> dict[str, list[Mutant]]:
    """Every change of the package, by kind; none of annotations or f-strings."""
    found = defaultdict[str, list[Mutant]](list)
    for path in sorted((ROOT / "sonarrec").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        nodes: list[tuple[ast.AST, bool]] = [(ast.parse(path.read_text(encoding="utf-8")), True)]
        while nodes:
            node, is_global = nodes.pop()
            if isinstance(node, ast.expr | ast.Return):
                start = node.lineno, node.col_offset
                end = node.end_lineno or 0, node.end_col_offset or 0
                for kind, text in mutants_of(node):
                    found[kind].append(Mutant(name, start, end, text, is_global))
            skipped = {id(getattr(node, "annotation", None)), id(getattr(node, "returns", None))}
            inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            if not isinstance(node, ast.JoinedStr):  # Python 3.11 does not say where its parts are
                children = [c for c in ast.iter_child_nodes(node) if id(c) not in skipped]
                nodes += [(child, is_global and not inside) for child in children]
    return found


def mutated(source: bytes, mutant: Mutant) -> bytes:
    """A module's source with one change."""
    lines = source.splitlines(keepends=True)
    starts = [sum(map(len, lines[: line - 1])) for line in (mutant.start[0], mutant.end[0])]
    begin, end = starts[0] + mutant.start[1], starts[1] + mutant.end[1]
    return source[:begin] + mutant.text.encode() + source[end:]


# As a plugin of pytest: what each test takes, and which tests are run in which order.

_seconds: dict[str, float] = defaultdict(float)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _seconds[report.nodeid] += report.duration


def pytest_sessionfinish(session: pytest.Session) -> None:
    if SECONDS in os.environ and not hasattr(session.config, "workerinput"):
        Path(os.environ[SECONDS]).write_text(json.dumps(_seconds), encoding="utf-8")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if ORDER in os.environ:
        order = json.loads(Path(os.environ[ORDER]).read_text(encoding="utf-8"))
        place = {name: n for n, name in enumerate(order)}
        items[:] = sorted((i for i in items if i.nodeid in place), key=lambda i: place[i.nodeid])


def run_pytest(folder: Path, *words: str, timeout: float | None = None, **environment: str) -> int:
    """Exit code of pytest on a tree; 1 where it takes longer than timeout, s."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "tests.support.mutants",
        "-p",
        "no:cacheprovider",
    ]
    paths = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"} | environment
    try:
        done = subprocess.run(
            [*command, *words], cwd=folder, env=paths, capture_output=True, timeout=timeout
        )
    except subprocess.TimeoutExpired:
        return 1
    return done.returncode


# Which tests cover which line


def measure(tests: str) -> None:
    """Run the tests with coverage, and keep what they cover and what each takes."""
    KEPT.mkdir(parents=True, exist_ok=True)
    print("which tests cover which line: they are run once, with coverage", flush=True)
    kept = {SECONDS: str(KEPT / "seconds.json"), "COVERAGE_FILE": str(KEPT / "coverage")}
    words = ["--cov=sonarrec", "--cov-context=test", "--cov-report="]
    run_pytest(ROOT, *words, *(["-m", tests] if tests else []), **kept)


class Covering:
    """Which tests run a line, quick ones first."""

    def __init__(self) -> None:
        self._seconds = json.loads((KEPT / "seconds.json").read_text(encoding="utf-8"))
        self._data = CoverageData(str(KEPT / "coverage"))
        self._data.read()
        self._files = {
            Path(f).as_posix().rpartition("/sonarrec/")[2]: f for f in self._data.measured_files()
        }

    def tests(self, mutant: Mutant) -> list[str]:
        """Of a line that is run at import: those that run anything of its module."""
        file = self._files.get(mutant.file.removeprefix("sonarrec/"))
        by_line = self._data.contexts_by_lineno(file) if file else {}
        lines = by_line if mutant.is_global else range(mutant.start[0], mutant.end[0] + 1)
        found = {c.rpartition("|")[0] for line in lines for c in by_line.get(line, ()) if c}
        return sorted(found & set(self._seconds), key=self.cost)

    def cost(self, test: str) -> float:
        """What a test takes, s."""
        return float(self._seconds[test])


@click.command()
@click.option("--count", default=150, help="How many mutants are drawn.")
@click.option("--seed", default=0)
@click.option("--tests", default="not slow", help="Which tests, as pytest's -m; '' for all.")
@click.option("--most-seconds", default=300.0, help="Of the tests of one mutant, the cheapest.")
def main(count: int, seed: int, tests: str, most_seconds: float) -> None:
    """Draw mutants, run the tests that cover them, and print those that none notices."""
    if not (KEPT / "coverage").exists():
        measure(tests)
    covering, rng = Covering(), random.Random(seed)
    kinds = all_mutants()
    drawn = [rng.choice(kinds[rng.choice(sorted(kinds))]) for _ in range(count)]
    rooms = defaultdict[str, list[str]](list)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "tree"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".venv", ".git", "build"))
        # Recordings that some tests read where they are at hand.
        (Path(folder) / "shared").symlink_to(ROOT.parent / "shared")
        for n, mutant in enumerate(drawn, 1):
            chosen, left = [], most_seconds
            for test in covering.tests(mutant):
                left -= covering.cost(test)
                chosen += [test] if left > 0 or not chosen else []
            end = _end_of(copy, mutant, chosen, most_seconds) if chosen else "not covered"
            where = f"{mutant.file}:{mutant.start[0]}"
            rooms[mutant.file.removesuffix(".py").split("/")[1]].append(end)
            print(f"{n:4} {end:12} {where} ({len(chosen)} tests)", flush=True)
            if end != "killed":
                print(difference(mutant), flush=True)
    for room, ends in sorted(rooms.items()):
        print(f"{room:12} {ends.count('killed'):4} of {len(ends)} killed")


def _end_of(copy: Path, mutant: Mutant, tests: list[str], most_seconds: float) -> str:
    """What becomes of a mutant."""
    file, order = copy / mutant.file, copy.parent / "order.json"
    file.write_bytes(mutated(file.read_bytes(), mutant))
    end = "ALIVE"
    # To collect tests takes long; the first few find most mutants.
    for part in (tests[:20], tests[20:150], tests[150:]):
        if part and end == "ALIVE":
            order.write_text(json.dumps(part), encoding="utf-8")
            files = sorted({test.partition("::")[0] for test in part})
            timeout = 60 + 5 * most_seconds
            code = run_pytest(copy, "-x", "-n0", *files, timeout=timeout, **{ORDER: str(order)})
            end = "ALIVE" if code in (0, NO_TESTS) else "killed"
    shutil.copy2(ROOT / mutant.file, file)
    return end


def difference(mutant: Mutant) -> str:
    """The lines that a mutant changes, before and after."""
    source = (ROOT / mutant.file).read_bytes()
    old, new = source.decode().splitlines(), mutated(source, mutant).decode().splitlines()
    first, end = mutant.start[0] - 1, mutant.end[0]
    changed = new[first : end + len(new) - len(old)]
    return "\n".join([f"     - {x}" for x in old[first:end]] + [f"     + {x}" for x in changed])


if __name__ == "__main__":
    main()
