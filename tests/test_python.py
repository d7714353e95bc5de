"""What a program uses: `import sonarrec`, and the page of its manual, which is run."""

from __future__ import annotations

import doctest
import inspect
import operator
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sonarrec
from sonarrec.errors import SonarrecError, UsageError
from tests.support.batch import SAMPLE, made
from tests.support.command import sonarrec as command

ROOT = Path(__file__).parents[1]
NAMES = {
    *("Recogniser", "compare", "evaluate", "load_landmarks", "map_landmarks", "open_log"),
    *("overlay", "preset", "read_results", "report", "run", "simulate"),
}

WITH_EXAMPLES = ("evaluate", "open_log", "read_results", "run", "simulate")


def test_import_alone_loads_nothing_heavy_nor_of_ours() -> None:
    code = (
        "import sys, sonarrec\n"
        "print(sorted(m for m in sys.modules if m.startswith('sonarrec.') or m in "
        "('numpy', 'cv2', 'pandas', 'scipy', 'matplotlib', 'mcap', 'click')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_name_is_there_and_no_other() -> None:
    assert {*sonarrec.__all__} - {"__version__"} == NAMES
    assert set(dir(sonarrec)) == {*NAMES, "__version__"}
    # In one process: a submodule that is imported must not stand in the place of a function.
    for name in sorted(NAMES):
        assert callable(getattr(sonarrec, name)), name
        assert getattr(sonarrec, name).__doc__, name
    assert not hasattr(sonarrec, "recognise")


@pytest.mark.parametrize("name", [*sorted(NAMES), "Recogniser.recognise"])
def test_docstrings_list_parameters_results_and_errors(name: str) -> None:
    """In numpy's form, each parameter of the signature on a line of its own."""
    function = operator.attrgetter(name)(sonarrec)
    sections = re.split(r"\n(\w+)\n-+\n", f"\n{inspect.getdoc(function)}")
    text = dict(zip(sections[1::2], sections[2::2], strict=True))
    result = {"Recogniser": set(), "Recogniser.recognise": {"Yields"}}.get(name, {"Returns"})
    examples = {"Examples"} if name in WITH_EXAMPLES else set()
    assert {*text} == {"Parameters", "Raises", *result, *examples}
    listed = re.findall(r"^(\S.*?)(?: : .+)?$", text["Parameters"], re.MULTILINE)
    stated = [one.lstrip("*") for line in listed for one in line.split(", ")]
    assert stated == [one for one in inspect.signature(function).parameters if one != "self"]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_of_docstrings_give_what_they_show(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sample_data").symlink_to(SAMPLE.parent, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner()
    [example] = finder.find(getattr(sonarrec, name), name, globs={"sonarrec": sonarrec})
    assert example.examples
    assert not runner.run(example).failed


@pytest.mark.slow
def test_the_page_s_code_runs_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("pan.mcap", "pan.sonar.toml", "pan.gt.csv"):
        (tmp_path / "sample_data").mkdir(exist_ok=True)
        shutil.copy(SAMPLE.parent / name, tmp_path / "sample_data" / name)
    shutil.copytree(SAMPLE.parent / "polar", tmp_path / "sample_data" / "polar")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "sonarrec" / "help" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 7
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, "python.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "results/pan 128 frames" in printed
    assert re.search(r"strict +framework", printed)
    assert "unchanged: TPR 0.99" in printed
    for written in ("results/report.html", "shots/000033.png"):
        assert Path(written).is_file()
    assert re.search(r"framework ID\.[13] \d\.\d\d m", printed)
    assert printed.splitlines()[-1] == "10"
    for name in NAMES:
        assert f"sonarrec.{name}" in text, name


@pytest.mark.slow
def test_functions_give_what_commands_write(tmp_path: Path) -> None:
    """Of two logs and one that is not there, in two processes; each table against its file."""
    for log in (*made(tmp_path, "a", frames=12), *made(tmp_path, "b", frames=9)):
        shutil.copy(SAMPLE / "gt.csv", log)
    logs, out = [tmp_path / name for name in ("a", "gone", "b")], tmp_path / "out"
    done = sonarrec.run(logs, out, jobs=2)
    assert repr(done) == f"<{out}: 2 logs, 21 frames; 1 failed>"
    written = pd.read_csv(out / "logs.csv")
    assert written.log.tolist() == done.table.log.tolist() == ["a", "gone", "b"]
    assert done.table.status.tolist() == ["done", "failed", "done"]
    assert "no such file" in done.table.message[1]
    assert [summary.folder.name for summary in done] == ["a", "b"]
    assert repr(next(iter(done))).startswith(f"<{out / 'a'}: 12 frames, ")
    with pytest.raises(SonarrecError, match="no such file"):
        sonarrec.run([tmp_path / "gone"], out)
    with pytest.raises(UsageError, match="observe"):
        sonarrec.run(logs, out, observe=print)

    scores = sonarrec.evaluate(out, out=tmp_path / "scored", method=["framework"])
    command("evaluate", "-q", out, "--method", "framework", code=3)
    for name in ("figures.csv", "confusion.csv", "evaluation.json"):
        expected = (out / "evaluation" / name).read_bytes()
        assert (tmp_path / "scored" / name).read_bytes() == expected, name
    assert scores.table.index.tolist() == ["framework"]
    totals = scores.confusion[scores.confusion.landmark == "total"].set_index("protocol")
    assert scores.table["paper TPR"].item() == totals.tpr["paper"]
    assert scores.table["strict FPR"].item() == totals.fpr["strict"]
    assert len(repr(scores)) < 120

    sonarrec.run(logs[::2], tmp_path / "strict", preset=_claiming_nothing())
    found = sonarrec.compare(out, tmp_path / "strict")
    command("evaluate", "-q", "--compare", out, tmp_path / "strict")
    files = tmp_path / "strict" / "evaluation"
    assert repr(found) == f"<{found.verdict}>"
    assert found.verdict.startswith("worse: TPR 0.9048 -> 0.0000")
    np.testing.assert_allclose(found.figures.new, pd.read_csv(files / "compare.csv").new)

    page = sonarrec.report(out, tmp_path / "page.html", logs=[logs[0], logs[2]])
    assert page.path.is_file()
    drawn = sonarrec.overlay(logs[0], tmp_path / "drawn", results=out, frames=(2, 4))
    assert "<2 frames" in repr(drawn)
    assert len([*(tmp_path / "drawn").glob("*.png")]) == 2

    site = sonarrec.map_landmarks(out / "a", tmp_path / "map")
    assert repr(site) == f"<map of {len(site.landmarks)} landmark from 1 log>"
    pd.testing.assert_frame_equal(site.landmarks, pd.read_csv(tmp_path / "map" / "map.csv"))
    assert set(site.passes.log) == {"a"}


def _claiming_nothing() -> Any:
    settings = sonarrec.preset("default")
    return replace(settings, features=replace(settings.features, declare=1.0))


def test_frame_by_frame_is_what_a_run_writes(tmp_path: Path) -> None:
    (folder,) = made(tmp_path, "pings", frames=10)
    written = sonarrec.read_results(sonarrec.run(str(folder), str(tmp_path / "out")).folder)
    with sonarrec.open_log(folder) as log:
        frames = list(log)
        fan = log.fan
    assert fan is not None
    with sonarrec.open_log(str(folder), sonar={"frame_rate_hz": 4.0}) as log:
        by_log = list(sonarrec.Recogniser(log).recognise())
    by_fan = list(sonarrec.Recogniser(fan).recognise(frames))
    for found in (by_log, by_fan):
        assert [r.index for r in found] == written.frames.frame.tolist()
        scores = [e.score for r in found for e in r.estimates]
        np.testing.assert_allclose(scores, written.estimates.score, atol=5.1e-7)
    assert written.sightings is not None
    assert set(written.sightings.method) <= set(written.estimates.method)
    with pytest.raises(UsageError, match="needs frames"):
        list(sonarrec.Recogniser(fan).recognise())
    small, wide = frames[1].image[:-1], frames[1].image.astype(np.uint16)
    for image, told in ((small, f"{fan.rows - 1}, "), (wide, "uint16")):
        with pytest.raises(UsageError, match=f"image of .*{told}"):
            list(sonarrec.Recogniser(fan).recognise([frames[0], replace(frames[1], pixels=image)]))
    with pytest.raises(UsageError, match="frame 3"):
        list(sonarrec.Recogniser(fan).recognise([frames[3], frames[3]]))


def test_polar_frames_of_one_s_own_are_as_the_fan_needs_them(tmp_path: Path) -> None:
    """Others were told by a traceback of OpenCV, or were recognised in the wrong place."""
    log = sonarrec.simulate("sample_polar", tmp_path / "log", frames=2)
    with sonarrec.open_log(log) as opened:
        frames = list(opened)
        fan = opened.fan
    assert fan is not None
    assert len(list(sonarrec.Recogniser(fan, "paper").recognise(frames))) == 2
    short, narrow, deep = frames[1].pixels[:-1], frames[1].pixels[:, :-1], frames[1].pixels * 1.0
    for pixels, told in ((short, "255, 96.* needs .256, 96"), (narrow, "256, 95"), (deep, "float")):
        with pytest.raises(UsageError, match=f"image of .*{told}"):
            list(sonarrec.Recogniser(fan).recognise([frames[0], replace(frames[1], pixels=pixels)]))
    other = replace(fan, rows=fan.rows + 1)
    with pytest.raises(UsageError, match=f"of .{fan.rows}, .* needs .{other.rows}, "):
        list(sonarrec.Recogniser(other).recognise(frames))


def test_a_url_is_no_folder_to_write_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The results went to a local folder `s3:`."""
    monkeypatch.chdir(tmp_path)
    for write, source in ((sonarrec.run, SAMPLE), (sonarrec.simulate, "sample_pan")):
        with pytest.raises(UsageError, match="s3://dives/out: "):
            write(source, "s3://dives/out")
    assert "s3://dives/out: " in command("simulate", "-o", "s3://dives/out", code=2).stderr
    assert not list(tmp_path.iterdir())


def test_settings_of_one_name_are_refused(tmp_path: Path) -> None:
    """Their estimates were mixed under one name of a method."""
    own = replace(sonarrec.preset("default"), seed=3)
    for chosen in (["default", own], ["offline", "offline"], []):
        with pytest.raises(UsageError, match="preset"):
            sonarrec.run(SAMPLE, tmp_path, preset=chosen)
        with sonarrec.open_log(SAMPLE) as log, pytest.raises(UsageError, match="preset"):
            sonarrec.Recogniser(log, preset=chosen)
    told = command("run", SAMPLE, "--preset", "default, default", "-o", tmp_path, code=2).stderr
    assert "preset" in told
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("span", [(-3, None), (0, -1), (2, 2), (0, 10**18), (1.5, 3)])
def test_frames_that_no_run_toml_can_tell_are_refused(
    span: tuple[int, int | None], tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="--frames"):
        sonarrec.run(SAMPLE, tmp_path, frames=span)


def test_what_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SonarrecError, match="no such file"):
        sonarrec.read_results(tmp_path)
    with pytest.raises(SonarrecError, match="results folder"):
        sonarrec.evaluate(str(tmp_path / "gone"), str(SAMPLE / "gt.csv"))
