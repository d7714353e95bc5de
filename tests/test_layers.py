"""Imports run downward only: read off the syntax trees, so that nothing has to be run."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "sonarrec"
MODULES = {
    ".".join(("sonarrec", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
        ".__init__"
    ): path
    for path in PACKAGE.rglob("*.py")
}
STAGES = {name for name in MODULES if name.startswith("sonarrec.recogniser.stage")}
READERS = {name for name in MODULES if name.startswith("sonarrec.readers")}
CLI = {name for name in MODULES if name.startswith("sonarrec.cli")}
# What `sonarrec --help`, `run` and `simulate` load; heavy packages must not come with it.
LIGHT = (
    "sonarrec.cli",
    "sonarrec.run",
    "sonarrec.simulation.simulate",
    "sonarrec.readers.mcap_file",
)
HEAVY = {"pandas", "matplotlib", "scipy"}


def imports(name: str, top_level_only: bool = False) -> set[str]:
    """Dotted names that a module imports; of `from a import b` a.b where that is our module."""
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    found = set()
    for node in tree.body if top_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import"
            assert node.module is not None
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= names & set(MODULES)
            if not names <= set(MODULES):
                found.add(node.module)
    return found


def ours(name: str, top_level_only: bool = False) -> set[str]:
    """The modules of the package that a module imports, by default at any depth of its code."""
    return imports(name, top_level_only) & set(MODULES) - {"sonarrec"}


def packages(names: set[str]) -> set[str]:
    return {name.partition(".")[0] for name in names}


def test_the_modules_are_found() -> None:
    assert len(STAGES) == 11
    assert "sonarrec.readers.mcap_file" in READERS


def test_records_import_nothing_of_ours() -> None:
    assert not ours("sonarrec.records")


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_stages_know_neither_each_other_nor_a_reader(stage: str) -> None:
    same = {name for name in STAGES if name.startswith(".".join(stage.split(".")[:3]))}
    assert not ours(stage) & ((STAGES | READERS) - same)


@pytest.mark.parametrize("name", sorted(MODULES))
def test_layers(name: str) -> None:
    if name not in CLI | {"sonarrec.__main__"}:
        assert not ours(name) & CLI
        assert not packages(imports(name)) & {"click", "tqdm"}
    if "mcap" not in name:  # the modules that know the format say so in their name
        assert "mcap" not in packages(imports(name))


@pytest.mark.parametrize("name", LIGHT)
def test_heavy_packages_are_imported_where_used(name: str) -> None:
    loaded, new = set(), {name}
    while new:
        loaded |= new
        new = set().union(*(ours(n, top_level_only=True) for n in new)) - loaded
    for module in sorted(loaded):
        assert not packages(imports(module, top_level_only=True)) & HEAVY, module


def test_cli_imports_little_at_the_top() -> None:
    for name in CLI:
        assert ours(name, top_level_only=True) <= CLI | {"sonarrec.records"}


def test_no_circle() -> None:
    """Every module can be put below all that import it."""
    left = {name: ours(name) for name in MODULES}
    while left:
        lowest = {name for name, needs in left.items() if not needs & set(left) - {name}}
        assert lowest, f"modules that import each other: {sorted(left)}"
        left = {name: needs for name, needs in left.items() if name not in lowest}
