"""The page on many logs: it opens with what differs from the rest, and stays small."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sonarrec.evaluation.cells import scored_by
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.match import ScoringOptions
from sonarrec.reports.build import write_report
from sonarrec.reports.logs import MOST_LOGS
from tests.support.command import sonarrec
from tests.support.made_up import make_logs
from tests.support.pages import tables

MANY = 60
MOST_BYTES = 800_000
"""Of a page without pictures: 8 logs with panels of some 40 kB, tables and curves of 300 kB."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixty logs: one with false claims in every frame, one cut short, one damaged, one failed."""
    pairs = make_logs(tmp_path_factory.mktemp("many") / "made", MANY, 200, 6)
    out = pairs.parent / "out"
    bad = out / "log0031" / "estimates.csv"
    text = bad.read_text(encoding="utf-8")
    bad.unlink()
    bad.write_text(re.sub(r"(framework,1,.*),0\n", r"\1,1\n", text), encoding="utf-8")
    cut, damaged = (out / name / "run.toml" for name in ("log0044", "log0050"))
    run = cut.read_text(encoding="utf-8")
    cut.write_text(run.replace("finished = true", "finished = false"), encoding="utf-8")
    run = damaged.read_text(encoding="utf-8")
    damaged.write_text(run + 'problems = ["frame 3: cut"]\n', encoding="utf-8")
    (out / "logs.csv").write_text(
        "log,path,status,frames,unusable,seconds,declared,message\n"
        "gone,dives/gone.mcap,failed,0,0,1.0,0,dives/gone.mcap: <b>no MCAP</b>\n"
        "log0007,a/log0007,done,200,0,1.0,0,\n"
        "log0007,b/log0007,failed,0,0,1.0,0,b/log0007: no sonar\n",
        encoding="utf-8",
    )
    return pairs


@pytest.fixture(scope="module")
def page(made: Path) -> Path:
    gt = made.parent / "gt.csv"
    rows = ["log,frame,landmark,range_m,bearing_deg"]
    for n in range(MANY):
        own = (made.parent / f"kind{n % 6}" / "gt.csv").read_text(encoding="utf-8")
        rows += [f"log{n:04d},{line}" for line in own.splitlines()[1:]]
    gt.write_text("\n".join(rows) + "\n", encoding="utf-8")
    page = made.parent / "page.html"
    sonarrec("report", made.parent / "out", "--ground-truth", gt, "-o", page, code=3)
    return page


def section(text: str, name: str) -> str:
    return text[text.index(f'<section id="{name}"') :].partition("</section>")[0]


@pytest.mark.slow
def test_it_opens_with_what_differs(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    first = text[text.index("<main>") :]
    assert f"<h1>{MANY} logs</h1>" in text
    assert first.index('id="standing"') < first.index('id="rates"') < first.index('id="seen"')
    stands = section(text, "standing")
    told = re.findall(
        r'<th scope="row" class="text">(.*?)</th><td class="text wide">(.*?)</td>', stands
    )
    reasons = dict(told)
    assert told[0] == ("gone", "failed: dives/gone.mcap: &lt;b&gt;no MCAP&lt;/b&gt;")
    assert "failed" not in reasons.get("log0007", ""), "a namesake of what stands"
    assert reasons["log0044"] == "partial: the run was cut short"
    assert reasons["log0050"] == "partial: frame 3: cut"
    assert "most mistakes of framework" in reasons["log0031"]
    assert re.search(r"most false claims of framework: \d{3}", reasons["log0031"])
    assert next(name for name, why in told if "most mistakes" in why) == "log0031"
    assert f"{MOST_LOGS} of {MANY} logs have panels below" in stands


@pytest.mark.slow
def test_only_some_have_panels_and_the_figures_are_of_all(page: Path, made: Path) -> None:
    text = page.read_text(encoding="utf-8")
    shown = re.findall(r"<h3>(log\d{4})</h3>", section(text, "seen"))
    assert len(shown) == MOST_LOGS
    assert {"log0031", "log0044", "log0050"} <= set(shown)
    assert section(text, "rates").count('<th scope="row" class="text">log') == 40
    found = evaluate_logs(made.parent / "out", made.parent / "gt.csv")
    count = scored_by(found.counts, "framework", "strict").count()
    assert f"framework: {count.fp:,} false claims, {count.fn} missed" in section(text, "mistakes")


@pytest.mark.slow
def test_the_page_stays_small(page: Path, made: Path) -> None:
    """Without truth as well; what is not known then is told from the number of sightings."""
    assert page.stat().st_size < MOST_BYTES
    bare = made.parent / "bare.html"
    sonarrec("report", made.parent / "out", "-o", bare, code=3)
    assert bare.stat().st_size < MOST_BYTES
    stands = section(bare.read_text(encoding="utf-8"), "standing")
    assert "sightings of framework: " in stands
    assert "failed: " in stands


PLACED = "frame,method,object,range_m,bearing_deg,landmark,score,declared"
RIGHT = [f"{n},framework,1,2.0,0,1,.9,1" for n in range(10, 20)]


def plain_logs(root: Path, estimates: dict[str, list[str]], truth: list[str]) -> Path:
    """Logs of 40 frames in folders, by name their estimates.csv, and their truth."""
    for n, (name, lines) in enumerate(estimates.items()):
        tables(root / "out" / name, range(40), lines[0], lines[1:])
        run = f'finished = true\n[input]\nname = "{name}"\nsha256 = "{n:064x}"\n'
        (root / "out" / name / "run.toml").write_text(run)
    lines = ["log,frame,landmark,range_m,bearing_deg", *truth, ""]
    (root / "gt.csv").write_text("\n".join(lines))
    return root / "out"


@pytest.mark.parametrize(("logs", "scored"), [(3, True), (11, True), (11, False)])
def test_a_log_that_cannot_be_read_is_left_out(tmp_path: Path, logs: int, scored: bool) -> None:
    """The last two, which would have no panel of many; where no other is left it is an error."""
    names = [f"log{n:02d}" for n in range(logs)]
    truth = [f"{name},{n},1,2.0,0" for name in names for n in range(10, 20)]
    out = plain_logs(tmp_path, {name: [PLACED, *RIGHT] for name in names}, truth)
    *others, empty, bad = names
    (out / empty / "frames.csv").write_text("frame\n")
    run = out / empty / "run.toml"
    run.write_text(run.read_text().replace("finished = true", "finished = false"))
    (out / bad / "estimates.csv").write_text(f"{PLACED}\n10,framework,1,2.0,0,1,high,1\n")
    given = ["--ground-truth", tmp_path / "gt.csv"] if scored else []
    page = tmp_path / "page.html"
    done = sonarrec("report", out, *given, "-o", page, code=3)
    lines = done.stderr.splitlines()
    told = "scored" if scored else "shown"
    assert sorted(lines, key=lambda line: line[-20:]) == [
        f"sonarrec: {out / empty / 'frames.csv'}: no frame was processed; {empty} is not {told}",
        f"sonarrec: {out / bad / 'estimates.csv'} line 2: score must be a finite number, not "
        f"'high'; {bad} is not {told}",
    ]
    text = page.read_text(encoding="utf-8")
    if logs > MOST_LOGS + 2:
        assert re.findall(r"<h3>(log\d\d)</h3>", section(text, "seen")) == others[:MOST_LOGS]
    assert text.count(f"{empty} is not {told}") == 1
    assert "none differs" not in text
    for name in others:
        (out / name / "frames.csv").write_text("frame\n")
    done = sonarrec("report", out, *given, "-o", page, code=1)
    assert done.stderr.count("\n") == 1


def test_mistakes_are_told_as_all_logs_are_scored(tmp_path: Path) -> None:
    """The last log lacks positions, so that protocol paper alone is scored; it has no panel, and
    of those that have, a claim of ID.1 three metres off is no mistake in it."""
    far = [f"{n},framework,1,5.0,0,1,.9,1" for n in range(10, 20)]
    absent = "30,framework,1,2.0,0,2,.8,1"
    estimates = {f"log{n:02d}": [PLACED, *far, absent] for n in range(11)}
    head = "frame,method,landmark,score,declared"
    estimates["log11"] = [head, *(f"{n},framework,1,.9,1" for n in range(10, 20))]
    truth = [f"{log},{n},1,2.0,0" for log in estimates for n in range(10, 20)]
    out = plain_logs(tmp_path, estimates, truth)
    count = scored_by(evaluate_logs(out, tmp_path / "gt.csv").counts, "framework", "paper").count()
    assert (count.fp, count.fn) == (11, 0)
    page = tmp_path / "page.html"
    write_report(page, out, ground_truth=tmp_path / "gt.csv")
    told = section(page.read_text(encoding="utf-8"), "mistakes")
    assert "framework: 11 false claims, 0 missed" in told
    assert told.count("ID.2 declared (0.80) while it is not in view") == MOST_LOGS
    assert "ID.1" not in told.partition("smi: ")[0]


def test_sightings_are_those_of_the_method_shown(tmp_path: Path) -> None:
    """The third log has many of smi, which the page does not follow, the fourth of framework."""
    every, once = [0, 15, 30], [5]
    estimates = {}
    for n in range(10):
        smi, own = every if n == 2 else once, every if n == 3 else once
        rows = [(f, "smi") for f in smi] + [(f, "framework") for f in own]
        estimates[f"log{n}"] = [PLACED, *(f"{f},{m},1,2.0,0,1,.9,1" for f, m in sorted(rows))]
    out = plain_logs(tmp_path, estimates, [])

    def told(method: str | None) -> list[tuple[str, str]]:
        options = ScoringOptions(methods=(method,) if method else ())
        write_report(tmp_path / "page.html", out, options=options)
        stands = section((tmp_path / "page.html").read_text(encoding="utf-8"), "standing")
        return re.findall(r'(log\d)</th><td class="text wide">(.*?)</td>', stands)

    assert told(None) == [("log3", "sightings of framework: 3, where 1 are usual")]
    assert told("smi") == [("log2", "sightings of smi: 3, where 1 are usual")]
