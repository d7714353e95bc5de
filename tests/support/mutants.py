"""`make mutants`: changes the package at random, one place at a time, and runs the tests on it.

A mutant that no test notices shows what the tests do not assert. Which tests run a line, and how
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
from difflib import unified_diff
from pathlib import Path
from typing import NamedTuple

import click
import pytest
from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "build" / "mutants"
NO_TESTS = 5  # exit code of pytest
ORDER, SECONDS = "MUTANTS_ORDER", "MUTANTS_SECONDS"  # files that this module reads as a plugin
OTHER = {ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq}
OTHER |= {ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn}
OTHER |= {ast.NotIn: ast.In, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div}
OTHER |= {ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult}
OTHER |= {ast.And: ast.Or, ast.Or: ast.And}
WITHOUT_EFFECT = ("strict", "frozen", "slots")  # keywords
EITHER_ORDER = ("max", "maximum", "min", "minimum", "hypot")


class Mutant(NamedTuple):
    """One change of the package. file: below ROOT. start, end: (line from 1, byte from 0).

    is_global: whether its line is run as the module is imported, by no test in particular.
    """

    file: str
    start: tuple[int, int]
    end: tuple[int, int]
    text: str
    is_global: bool


def changes(node: ast.AST) -> Iterator[tuple[str, str]]:
    """(kind, new text) of the changes of one node."""
    match node:
        case ast.Compare(left, [op], [right]):
            yield "comparison", ast.unparse(ast.Compare(left, [OTHER[type(op)]()], [right]))
        case ast.BinOp(left, op, right) if type(op) in OTHER:
            if not any(isinstance(getattr(x, "value", x), _JOINED) for x in (left, right)):
                other: ast.AST = ast.BinOp(left, OTHER[type(op)](), right)
                yield "arithmetic", f"({ast.unparse(other)})"
        case ast.Constant(bool(value)):
            yield "boolean", str(not value)
        case ast.Constant(int(value) | float(value)):
            yield "constant", repr(value * 2 if value and type(value) is int else value * 1.3 or 1)
        case ast.BoolOp(op, values):
            yield "boolean", f"({ast.unparse(ast.BoolOp(OTHER[type(op)](), values))})"
        case ast.UnaryOp(ast.Not(), operand):
            yield "boolean", f"bool({ast.unparse(operand)})"
        case ast.Return(value) if value is not None and ast.unparse(value) != "None":
            yield "return", "return None"
        case ast.Call(func, [first, second, *rest], keywords):
            starred = isinstance(first, ast.Starred) or isinstance(second, ast.Starred)
            same = ast.unparse(first) == ast.unparse(second)
            if not starred and not same and ast.unparse(func).split(".")[-1] not in EITHER_ORDER:
                yield "order", ast.unparse(ast.Call(func, [second, first, *rest], keywords))


_JOINED = (str, ast.JoinedStr, ast.List, ast.Tuple)  # what "+" joins


def all_mutants() -> dict[str, list[Mutant]]:
    """Every change of the package, by kind; none of annotations or f-strings."""
    found = defaultdict[str, list[Mutant]](list)
    for path in sorted((ROOT / "sonarrec").rglob("*.py")):
        nodes: list[tuple[ast.AST, bool]] = [(ast.parse(path.read_text(encoding="utf-8")), True)]
        while nodes:
            node, is_global = nodes.pop()
            if isinstance(node, ast.expr | ast.Return):
                start = node.lineno, node.col_offset
                end = node.end_lineno or 0, node.end_col_offset or 0
                for kind, text in changes(node):
                    file = path.relative_to(ROOT).as_posix()
                    found[kind].append(Mutant(file, start, end, text, is_global))
            # Python 3.11 does not say where parts of f-strings are.
            if isinstance(node, ast.JoinedStr) or getattr(node, "arg", None) in WITHOUT_EFFECT:
                continue
            inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            for field, value in ast.iter_fields(node):
                if field not in ("annotation", "returns"):
                    here = is_global and not (inside and field == "body")
                    parts = value if isinstance(value, list) else [value]
                    nodes += [(part, here) for part in parts if isinstance(part, ast.AST)]
    return found


def mutated(source: bytes, mutant: Mutant) -> bytes:
    """A module's source with one change."""
    lines = source.splitlines(keepends=True)
    (first, begin), (last, end) = mutant.start, mutant.end
    before = b"".join(lines[: first - 1]) + lines[first - 1][:begin]
    return before + mutant.text.encode() + lines[last - 1][end:] + b"".join(lines[last:])


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
        index = {name: n for n, name in enumerate(order)}
        items[:] = sorted((i for i in items if i.nodeid in index), key=lambda i: index[i.nodeid])


def run_pytest(folder: Path, *words: str, timeout: float | None = None, **environment: str) -> int:
    """Exit code of pytest on a tree; 1 where it takes longer than timeout, s."""
    command = [sys.executable, "-m", "pytest", "-p", "tests.support.mutants", *words]
    paths = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"} | environment
    try:
        return subprocess.run(
            [*command, "-p", "no:cacheprovider"],
            cwd=folder,
            env=paths,
            capture_output=True,
            timeout=timeout,
        ).returncode
    except subprocess.TimeoutExpired:
        return 1


@click.command()
@click.option("--count", default=150, help="How many mutants are drawn.")
@click.option("--seed", default=0)
@click.option("--tests", default="not slow", help="Which tests, as pytest's -m; '' for all.")
@click.option("--most-seconds", default=300.0, help="Of the tests of one mutant, the cheapest.")
def main(count: int, seed: int, tests: str, most_seconds: float) -> None:
    """Draw mutants, run the tests that run their lines, and print those that none notices."""
    kept = {SECONDS: str(KEPT / "seconds.json"), "COVERAGE_FILE": str(KEPT / "coverage")}
    if not (KEPT / "coverage").exists():
        KEPT.mkdir(parents=True, exist_ok=True)
        run_pytest(
            ROOT, "--cov=sonarrec", "--cov-context=test", "--cov-report=", "-m", tests, **kept
        )
    seconds = json.loads(Path(kept[SECONDS]).read_text(encoding="utf-8"))
    lines = CoverageData(kept["COVERAGE_FILE"])
    lines.read()
    kinds, rng, rooms = all_mutants(), random.Random(seed), defaultdict[str, list[str]](list)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "tree"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".venv", ".git", "build"))
        # Recordings that some tests read where they are at hand.
        (Path(folder) / "shared").symlink_to(ROOT.parent / "shared")
        for n in range(1, count + 1):
            mutant = rng.choice(kinds[rng.choice(sorted(kinds))])
            by_line = lines.contexts_by_lineno(str(ROOT / mutant.file))
            own = by_line if mutant.is_global else range(mutant.start[0], mutant.end[0] + 1)
            covering = {c.rpartition("|")[0] for line in own for c in by_line.get(line, ())}
            chosen, left = list[str](), most_seconds
            for test in sorted(covering & set(seconds), key=lambda t: float(seconds[t])):
                left -= seconds[test]
                chosen += [test] if left > 0 or not chosen else []
            end = end_of(copy, mutant, chosen, 60 + 5 * most_seconds) if chosen else "not covered"
            rooms[mutant.file.removesuffix(".py").split("/")[1]].append(end)
            print(f"{n:4} {end:12} {mutant.file}:{mutant.start[0]} ({len(chosen)} tests)")
            if end != "killed":
                old = (ROOT / mutant.file).read_bytes()
                both = (x.decode().splitlines() for x in (old, mutated(old, mutant)))
                print(*[*unified_diff(*both, n=0, lineterm="")][3:], sep="\n", flush=True)
    for room, ends in sorted(rooms.items()):
        print(f"{room:12} {ends.count('killed'):4} of {len(ends)} killed")


def end_of(copy: Path, mutant: Mutant, tests: list[str], timeout: float) -> str:
    """Whether one of the tests fails on a mutant: "killed" or "ALIVE"."""
    file, order, end = copy / mutant.file, copy.parent / "order.json", "ALIVE"
    file.write_bytes(mutated(file.read_bytes(), mutant))
    # To collect tests takes long; the first few find most mutants.
    for part in (tests[:20], tests[20:150], tests[150:]):
        if part and end == "ALIVE":
            order.write_text(json.dumps(part), encoding="utf-8")
            files = sorted({test.partition("::")[0] for test in part})
            code = run_pytest(copy, "-x", "-n0", *files, timeout=timeout, **{ORDER: str(order)})
            end = "ALIVE" if code in (0, NO_TESTS) else "killed"
    shutil.copy2(ROOT / mutant.file, file)
    return end


if __name__ == "__main__":
    main()
