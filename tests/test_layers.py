"""Who may import whom: read off the syntax trees, so that nothing has to be run."""

from __future__ import annotations

import ast
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from sonarrec.cli import COMMANDS

FLOORS = (
    {"arrays", "errors"},
    {"passes", "tables"},
    {"config", "landmarks", "sonar"},
    {"stretches"},
    {"recogniser", "readers", "results", "drawing"},
    {"truth", "runs"},
    {"evaluation", "overlays", "mapping"},
    {"advice"},
    {"learning", "reports"},
    {"simulation", "api"},
    {"cli"},
    {"__main__"},
)
"""The rooms from the ground up. A room imports from floors below its own; of its own, itself."""
PARTS = (
    *("evaluation.rows", "evaluation.mistakes", "evaluation.counts"),
    *("evaluation.uncertainty", "evaluation.figures"),
)
"""Modules that the rest of their room is built on: each knows of it only those named before."""
MOST_LINES = {
    "advice": 1474,
    "cli": 3176,
    "drawing": 696,
    "evaluation": 3131,
    "learning": 548,
    "mapping": 1463,
    "overlays": 631,
    "readers": 6502,
    "recogniser": 5786,
    "reports": 2687,
    "results": 1968,
    "runs": 1700,
    "simulation": 2617,
    "sonar": 964,
    "tables": 1132,
    "truth": 1297,
}
"""Limits of rooms, in lines: what each has now. A feature that needs more lines raises its room's
limit by these; a change that removes lines lowers it."""
SMALL = 400  # lines of a room of one module
STAGES = ("stage1", "stage2", "stage3")
MAY_IMPORT = {
    "click": ("cli",),
    "tqdm": ("cli",),
    "mcap": ("readers.containers.mcap", "simulation.mcap", "overlays.foxglove"),
    "lz4": ("readers.containers.mcap", "readers.containers.ros_bag"),
    "zstandard": ("readers.containers.mcap", "readers.messages.ros"),
    "rosbags": ("readers.messages.ros", "readers.containers.ros_bag"),
    "ruamel": ("readers.containers.bag_folder",),
    "google": ("readers.messages.foxglove",),  # protobuf
    "distributed": ("runs.cluster",),
    "msgspec": ("tables.toml", "truth.convert"),
    "tomllib": ("tables.toml",),
    "pandas": (
        "tables.read",
        "results.read",
        "evaluation.write",
        "evaluation.compare",
        "mapping.write",
        "runs.run",
    ),
    "matplotlib": ("evaluation.plots", "mapping.picture"),
    "fsspec": ("runs.remote",),
    "aiohttp": ("runs.remote",),
    "sshfs": ("runs.remote",),
    "jinja2": ("reports.template",),
    "tomli_w": ("results.write", "simulation.simulate"),
    "kornia_rs": ("readers.decode.pixels",),
    "cv2": (
        "sonar.geometry",
        "landmarks",  # pictures of drawn plates
        "drawing",
        "recogniser",
        "readers.decode.layout",
        "readers.decode.colour",
        "readers.decode.grey",
        "readers.decode.pixels",
        "readers.containers.video",
        "truth.convert",
        "simulation",
        "overlays",
        "reports.frames",
        "reports.review",
        "results.run_file",  # its version
    ),
}
"""Of each package but numpy the modules that may import it, by how their names begin."""
# What `sonarrec --help`, `run` and `simulate` load; heavy packages must not come with it.
LIGHT = (
    "cli",
    "runs",
    "advice.log",
    "api.run",
    "simulation.simulate",
    "readers.messages.images",
    "readers.poses",
)
HEAVY = {
    *("pandas", "matplotlib", "scipy", "rosbags", "google", "ruamel"),
    *("fsspec", "distributed"),
}

Sources = dict[str, str]
PACKAGE = Path(__file__).parents[1] / "sonarrec"


def named(path: Path) -> str:
    """A module's name inside the package: "" for the package itself, "readers" for a room."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__")


SOURCES: Sources = {
    named(path).removesuffix("."): path.read_text(encoding="utf-8")
    for path in sorted(PACKAGE.rglob("*.py"))
}


def imported(source: str, top_level_only: bool) -> set[tuple[str, str]]:
    """What a module imports: (a, "") of `import a`, (a, b) of `from a import b`."""
    return {name for name, is_top in imports(source) if is_top or not top_level_only}


@cache
def imports(source: str) -> frozenset[tuple[tuple[str, str], bool]]:
    """As `imported`, and whether it does where it is loaded."""
    tree = ast.parse(source)
    found: set[tuple[tuple[str, str], bool]] = set()
    top = set(map(id, tree.body))
    for node in ast.walk(tree):
        is_top = id(node) in top
        if isinstance(node, ast.Import):
            found |= {((alias.name, ""), is_top) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            found |= {((module, alias.name), is_top) for alias in node.names}
    return frozenset(found)


def ours(sources: Sources, name: str, top_level_only: bool = False) -> set[str]:
    """The modules of the package that a module imports, by default at any depth of its code.

    The package itself, which has the version, is not counted.
    """
    found = set()
    for module, what in imported(sources[name], top_level_only):
        inside = module.removeprefix("sonarrec").removeprefix(".")
        if module.partition(".")[0] == "sonarrec":
            part = f"{inside}.{what}".removeprefix(".")
            found.add(part if part in sources else inside)
    return found & set(sources) - {name, ""}


def others(sources: Sources, name: str, top_level_only: bool = False) -> set[str]:
    """The packages that a module imports, but for numpy and Python's own (tomllib is watched)."""
    first = {n.partition(".")[0] for n, _ in imported(sources[name], top_level_only)}
    return (
        first
        - (set(sys.stdlib_module_names) - {"tomllib"})
        - {"sonarrec", "numpy", "", "__future__"}
    )


def room(name: str) -> str:
    return name.partition(".")[0]


def begins(name: str, prefixes: tuple[str, ...]) -> bool:
    """Whether a module is one of these, in one, or named as one and more: overlay.foxglove_mcap."""
    return any(name == p or name.startswith((f"{p}.", f"{p}_")) for p in prefixes)


def stage(name: str) -> str | None:
    return next((s for s in STAGES if begins(name, (f"recogniser.{s}",))), None)


def loaded_with(sources: Sources, name: str) -> set[str]:
    """The modules of a room that are loaded with one of its modules, itself among them."""
    found, left = set(), [name]
    while left:
        found.add(one := left.pop())
        left += [o for o in ours(sources, one, True) - found if room(o) == room(name)]
    return found


def faults(sources: Sources) -> list[str]:
    """A line for every import that must not be."""
    floor = {r: i for i, rooms in enumerate(FLOORS) for r in rooms}
    found = []
    commands = ("cli", *(f"cli.{name}" for name in COMMANDS))  # `--help` loads all
    with_cli = set[str]().union(*(loaded_with(sources, name) for name in commands))
    for name in sources:
        if name == "":
            if ours(sources, name, top_level_only=True):
                found.append("sonarrec itself must import nothing of ours as it is loaded")
            continue
        if any(n.startswith(".") for n, _ in imported(sources[name], False)):
            found.append(f"{name}: relative import")
        for other in ours(sources, name):
            if room(other) != room(name) and floor[room(other)] >= floor[room(name)]:
                found.append(f"{name} imports uphill from {other}")
            for i, part in enumerate(PARTS):
                within = begins(name, (part,)) and room(other) == room(name)
                if within and not begins(other, PARTS[: i + 1]):
                    found.append(f"{name} imports uphill from {other}")
            if stage(name) and stage(other) and stage(name) != stage(other):
                found.append(f"{name}: a stage imports another, {other}")
        if name in with_cli:  # else `sonarrec --help` waits for what it does not need
            found += [
                f"{name} imports {other} before a command is run"
                for other in ours(sources, name, top_level_only=True)
                if room(other) not in ("cli", "errors") and other not in ("sonar.frame", "tables")
            ]
        found += [
            f"{name} must not import {package}"
            for package in others(sources, name)
            if not begins(name, MAY_IMPORT.get(package, ()))
        ]
    for name in filter(lambda n: begins(n, LIGHT), sources):
        for module in sorted(loaded(sources, name)):
            found += [
                f"{name} loads {package}, by {module}"
                for package in others(sources, module, top_level_only=True) & HEAVY
            ]
    return found + circle(sources)


def loaded(sources: Sources, name: str) -> set[str]:
    """All modules that come with one as it is imported, their packages among them."""
    done: set[str] = set()
    new = {name}
    while new:
        done |= new
        new = {n for one in new for n in ours(sources, one, top_level_only=True)}
        new |= {n.rpartition(".")[0] for n in done | new} - {""}
        new -= done
    return done


def circle(sources: Sources) -> list[str]:
    """Every module can be put below all that import it; else a line that names those left over."""
    left = {name: ours(sources, name) for name in sources if name}
    while left:
        lowest = {name for name, needs in left.items() if not needs & set(left)}
        if not lowest:
            return [f"modules that import each other: {', '.join(sorted(left))}"]
        left = {name: needs for name, needs in left.items() if name not in lowest}
    return []


def test_every_room_has_a_floor() -> None:
    assert sorted(r for rooms in FLOORS for r in rooms) == sorted({room(n) for n in SOURCES if n})


def test_no_room_exceeds_its_limit() -> None:
    lines = Counter[str]()
    for name, source in SOURCES.items():
        lines[room(name)] += source.count("\n")
    grown = [
        f"room {n!r} has {lines[n]} lines, and its limit is {most}: simplify it or, if a feature "
        f"needs the lines, set the limit to {lines[n]} in MOST_LINES of tests/test_layers.py"
        for n in sorted(lines)
        if lines[n] > (most := MOST_LINES.get(n, SMALL))
    ]
    assert not grown, "\n".join(grown)


def test_every_name_in_the_tables_is_there() -> None:
    for prefix in {*LIGHT, *PARTS, *(f"recogniser.{s}" for s in STAGES)} | {
        p for prefixes in MAY_IMPORT.values() for p in prefixes
    }:
        assert any(begins(name, (prefix,)) for name in SOURCES), prefix
    for package, prefixes in MAY_IMPORT.items():
        for prefix in prefixes:
            users = [n for n in SOURCES if begins(n, (prefix,)) and package in others(SOURCES, n)]
            assert users, f"{prefix} need not import {package}"


def test_imports_run_downward_only() -> None:
    assert faults(SOURCES) == []


PLANTED = """
passes: from sonarrec import config: passes imports uphill from config
recogniser.plane: def f(): from sonarrec.readers import open_log: from readers
recogniser.stage2: from sonarrec.recogniser.stage3 import reader: a stage imports another
evaluation.pairs: from sonarrec.evaluation import evaluate: import each other
evaluation.rows: from sonarrec.evaluation import counts: uphill from evaluation.counts
evaluation.evaluate: def f(): from sonarrec.advice.results import of_results: uphill from advice
runs.one: import click: runs.one must not import click
runs.one: from sonarrec.tables.read import read_table: runs.one loads pandas, by tables.read
cli.run: from sonarrec.runs.one import run_log: before a command is run
: from sonarrec.readers import open_log: nothing of ours as it is loaded"""
"""A module, a line in it, and what is told of it."""


@pytest.mark.parametrize("planted", PLANTED.splitlines()[1:])
def test_a_wrong_import_is_found(planted: str) -> None:
    module, _, rest = planted.partition(": ")
    line, _, told = rest.rpartition(": ")
    sources = SOURCES | {module: f"{SOURCES[module]}\n{line}\n"}
    assert any(told in fault for fault in faults(sources))


def test_texts_are_written_alike_on_every_system() -> None:
    """Windows has another encoding, and other ends of lines, where none are stated."""
    unstated = []
    for name, source in SOURCES.items():
        may_write = "write_text" in source or ".open(" in source
        for call in ast.walk(ast.parse(source)) if may_write else ():
            if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
                continue
            stated = {keyword.arg for keyword in call.keywords}
            mode = call.args[0] if call.args else None
            writes = call.func.attr == "write_text" and "encoding" in stated
            if call.func.attr == "open" and isinstance(mode, ast.Constant):
                writes = str(mode.value) in ("w", "x", "a", "r+", "w+")
            if writes and not {"encoding", "newline"} <= stated:
                unstated.append(f"{name}:{call.lineno}")
    assert unstated == []
