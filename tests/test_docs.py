"""The documentation does what it says: every command in it is run, and its lists are compared.

In README.md and sonarrec/help/*.md a line `$ COMMAND` of a code block is run, in order, in a fresh
copy of the sample data. Lines under it are what it prints, in order, `...` standing for anything.
`$ cat FILE` of a file that is not there yet makes it, and `$ nano FILE` any;
~/Downloads/dive.gt.csv is what a browser saved. A command that names a server is not run here:
tests/runs/test_remote.py has servers.
"""

from __future__ import annotations

import csv
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from sonarrec.cli import COMMANDS as COMMAND_NAMES
from sonarrec.cli import main
from sonarrec.cli.groups import page_texts
from sonarrec.cli.help import as_text
from sonarrec.mapping.write import MAP_COLUMNS, PASS_COLUMNS
from tests.support.command import sample_log, sonarrec
from tests.support.slow import but_first

ROOT = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").exists())
README = ROOT / "README.md"
PAGES = {page.stem: page for page in sorted((ROOT / "sonarrec" / "help").glob("*.md"))}
DOCUMENTS = [README, *PAGES.values()]


def commands() -> dict[str, click.Command]:
    """Every command by what a user types after `sonarrec`; of a group its commands."""
    found: dict[str, click.Command] = {}
    for name in COMMAND_NAMES:
        command = main.get_command(click.Context(main), name)
        if isinstance(command, click.Group):
            found |= {f"{name} {part}": c for part, c in command.commands.items()}
        else:
            found[name] = command
    return found


COMMANDS = commands()
TEXTS = page_texts()


def code_lines(document: Path) -> Iterator[str]:
    """The lines of code blocks without their indent, an empty line after each block."""
    indent: int | None = None  # of the fence that is open
    for line in document.read_text(encoding="utf-8").splitlines():
        if line.lstrip().startswith("```"):
            indent = None if indent is not None else len(line) - len(line.lstrip())
            yield ""
        elif indent is not None:
            yield line[indent:]
        else:
            yield line[4:] if line.startswith("    ") else ""


def examples(document: Path) -> list[tuple[str, list[str]]]:
    """Each command of a document, its continuations joined, and the lines shown under it."""
    found: list[tuple[str, list[str]]] = []
    shown: list[str] | None = None
    unfinished = False
    for line in code_lines(document):
        if unfinished:
            found[-1] = (found[-1][0].removesuffix("\\") + line.strip(), found[-1][1])
        elif line.lstrip().startswith("$ "):
            shown = []
            found.append((line.lstrip()[2:], shown))
        elif not line:
            shown = None
        elif shown is not None:
            shown.append(line)
        unfinished = bool(found) and found[-1][0].endswith("\\")
    return found


def run(command: str, folder: Path) -> str:
    """What a command prints, stderr first; `sonarrec` by itself runs in this process."""
    words = shlex.split(command, comments=True)
    if words[0] == "sonarrec" and not set(words) & {"|", "||", ">", "&&"}:
        result = CliRunner().invoke(main, words[1:])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        code, printed = result.exit_code, result.stderr + result.stdout
    else:
        paths = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=folder,
            env=os.environ | {"PATH": paths},
            capture_output=True,
            text=True,
            check=False,
        )
        code, printed = done.returncode, done.stderr + done.stdout
    assert code in (0, 3), f"$ {command}\n{printed}"
    return printed


@pytest.mark.parametrize(
    "document",
    but_first(sorted(DOCUMENTS, key=lambda path: path.stem != "formats")),
    ids=lambda path: path.stem,
)
def test_commands_in_order_print_what_is_shown(
    document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(ROOT / "sample_data", tmp_path / "sample_data")
    monkeypatch.chdir(tmp_path)
    if document == README:  # the MCAP of its reader: of a sonar that states all but its height
        run("sonarrec simulate --scene sample_polar --frames 24 -o my.mcap", tmp_path)
        (tmp_path / "my.sonar.toml").unlink()
    found = examples(document)
    without = document.stem in ("changes", "limits", "python")  # no command of the program
    assert without or any("sonarrec" in command for command, _ in found)
    for command, shown in found:
        words = command.split()
        if words[:2] == ["mv", "~/Downloads/dive.gt.csv"]:  # saved with all accepted
            saved = Path(words[2]) / "dive.gt.csv"
            run(f"sonarrec truth propose sonarrec_out/dive -o {saved}", tmp_path)
            saved.write_text(re.sub(r",(tracked|interpolated)\b", ",", saved.read_text()))
        elif words[0] == "nano" or (words[0] == "cat" and not Path(words[1]).exists()):
            Path(words[1]).write_text("\n".join(shown) + "\n", encoding="utf-8")
        elif words[0] != "make" and "://" not in command:
            printed = run(command, tmp_path)
            pattern = ".*".join(
                "\n" + ".*".join(re.escape(part) for part in line.split("..."))
                for line in shown
                if line.strip() != "..."
            )
            assert re.search(pattern, "\n" + printed, re.DOTALL), f"$ {command}\n{printed}"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_has_help_an_example_a_page_and_a_place_in_the_readme(name: str) -> None:
    command = COMMANDS[name]
    assert command.help
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{name} {parameter.opts[0]}"
            assert getattr(parameter, "group", None), f"{name} {parameter.opts[0]}"
    assert f"sonarrec {name}" in README.read_text(encoding="utf-8")
    lines = [line.strip() for line in command.help.splitlines() if "sonarrec " in line]
    typed = [line for line in lines if re.match(r"sonarrec [a-z]", line)]
    assert any(line.startswith(f"sonarrec {name}") for line in typed)
    for line in typed:
        used = {word for word in line.split() if word.startswith("-")}
        of = [c for n, c in COMMANDS.items() if line.startswith(f"sonarrec {n} ")]
        known = {o for p in (*of, command)[0].params for o in (*p.opts, *p.secondary_opts)}
        assert used <= known, line
    if name != "help":
        page = PAGES[name.partition(" ")[0]].read_text(encoding="utf-8")
        assert f"sonarrec {name}" in page


def test_help_lists_and_prints_the_pages() -> None:
    listed = CliRunner().invoke(main, ["help"]).stdout
    for name, text in TEXTS.items():
        assert re.search(rf"^  {name} +\S", listed, re.MULTILINE)
        told = CliRunner().invoke(main, ["help", name]).stdout
        assert not re.search(r"`|^#|^```", told, re.MULTILINE)
        words = [re.findall(r"\w+", one) for one in (told, re.sub("```[a-z]*|`", "", text))]
        assert words[0] == words[1]


def test_code_of_several_words_is_quoted_where_nothing_is_bold() -> None:
    page = "Type `sonarrec run LOG` or `q`."
    assert as_text(page, marked=False).strip() == "Type 'sonarrec run LOG' or q."
    assert "'" not in as_text(page, marked=True)


def test_help_is_in_groups() -> None:
    text = CliRunner().invoke(main, ["run", "--help"]).stdout
    groups = re.findall(r"^(\w+):$", text, re.MULTILINE)
    assert "\nMost used:\n  --sonar FILE " in text.split("\nInput:\n")[0]
    assert groups == ["Input", "Settings", "Geometry", "Output", "Other"]
    assert text.rstrip().endswith("More: sonarrec help run")


def listed_columns(page: str, file: str) -> list[str]:
    """The columns that a help page lists under `## FILE`."""
    text = TEXTS[page].partition(f"\n## {file}\n")[2].partition("\n## ")[0]
    names = re.findall(r"^    ([a-z].*?),?(?:  .*)?$", text, re.MULTILINE)
    return [column for several in names for column in several.split(", ")]


def test_the_columns_listed_are_the_columns_written(tmp_path: Path) -> None:
    results, sample = tmp_path / "pan", ROOT / "sample_data"
    shutil.copytree(sample / "regression" / "pan", results)
    score = ("evaluate", "-q", "--ground-truth", sample / "pan.gt.csv")
    sonarrec(*score, results)
    sonarrec(*score, "--compare", sample / "regression" / "pan", results)
    sonarrec("run", sample_log(tmp_path / "log", 10), "-o", tmp_path / "short", "-q")
    written = {
        path.name: path
        for folder in (results / "evaluation", tmp_path / "short" / "log", tmp_path / "short")
        for path in folder.glob("*.csv")
    }
    assert {"frames.csv", "confusion.csv", "compare.csv", "logs.csv"} <= set(written)
    for name, path in written.items():
        with path.open(newline="", encoding="utf-8") as file:
            header = next(csv.reader(file))
        listed = listed_columns("results", name)
        if "p_1 ... p_K" in listed:
            place = listed.index("p_1 ... p_K")
            listed[place : place + 1] = ["p_1", "p_2", "p_3", "p_4"]
        assert listed == header, name


def test_the_columns_of_a_map_are_those_listed() -> None:
    assert listed_columns("map", "map.csv") == [*MAP_COLUMNS]
    assert listed_columns("map", "passes.csv") == [*PASS_COLUMNS]


def test_an_unknown_page_names_the_known_ones_and_what_is_gone_what_to_use() -> None:
    result = CliRunner().invoke(main, ["help", "formts"])
    assert result.exit_code == 2
    assert all(name in result.stderr for name in PAGES)
    for *words, gone in (["status"], ["run", "x", "--tables"], ["overlay", "x", "--tilt-deg"]):
        done = CliRunner().invoke(main, [*words, gone])
        assert done.exit_code == 2
        assert f"`{gone}`" in done.stderr.partition(" Gone: ")[2].replace("run --tables", gone)
