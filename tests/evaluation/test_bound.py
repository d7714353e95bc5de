"""`evaluate --bound`: whether it holds, what it refuses, and how it reaches runs and reports."""

from __future__ import annotations

import math
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.evaluation.behaviour import DECLARES
from sonarrec.evaluation.bound import least_declare
from tests.support.claims import counts, matched
from tests.support.command import sonarrec

SAMPLES = Path(__file__).resolve().parents[2] / "sample_data"
OWN = DECLARES.index(0.75)


def passes(rng: np.random.Generator, count: int, false: np.ndarray) -> np.ndarray:
    """(count, D + 1, 2) claims of passes of ten claims at every declare, of which all are false
    with a probability of false[d], as it is from that declare down."""
    wrong = rng.uniform(size=(count, 1)) < false
    claims = np.stack([np.where(wrong, 0, 10), np.where(wrong, 10, 0)], axis=2)
    return np.concatenate([claims, claims[:, OWN : OWN + 1]], axis=1)


@pytest.mark.parametrize("first_bad", [0, DECLARES.index(0.97), DECLARES.index(0.85)])
@pytest.mark.parametrize("count", [100, 400])
def test_a_declare_at_which_too_many_are_false_is_chosen_in_one_of_twenty(
    first_bad: int, count: int
) -> None:
    """From there down the true share is just above the bound, where a mistake is likeliest."""
    share, rng = 0.05, np.random.default_rng(1)
    false = np.where(np.arange(len(DECLARES)) >= first_bad, share + 1e-9, 0.0)
    chosen = []
    for _ in range(2000):
        try:
            chosen.append(least_declare(passes(rng, count, false), share, 0.75)[0])
        except SonarrecError:
            continue
    wrong = sum(d <= DECLARES[first_bad] for d in chosen) / 2000
    assert wrong <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 2000)
    if count == 400 and first_bad:  # it is no empty promise
        assert len(chosen) > 1900


def test_without_a_false_claim_a_few_more_passes_than_the_rule_of_three_do() -> None:
    """log(1 / .05) / -log(1 - .02) = 149 passes at the least; log(1 / .035) for a start at .9."""
    rng, none = np.random.default_rng(2), np.zeros(len(DECLARES))
    with pytest.raises(SonarrecError, match="about 66 more passes like these would do"):
        least_declare(passes(rng, 100, none), 0.02, 0.75)
    declare, bound = least_declare(passes(rng, 166, none), 0.02, 0.75)
    assert (declare, bound.passes, bound.false_share) == (0.75, 166, 0)
    # Claims with a declare of .9 do not tell of one of .75.
    assert least_declare(passes(rng, 166, none), 0.02, 0.9)[0] == 0.9
    with pytest.raises(SonarrecError, match="would not do"):
        least_declare(passes(rng, 1000, none + 0.1), 0.02, 0.75)
    with pytest.raises(SonarrecError, match="no pass has a claim"):
        least_declare(0 * passes(rng, 100, none), 0.02, 0.75)


def test_claims_are_counted_by_pass_and_score() -> None:
    """Two passes; false claims belong to the nearest in time, undeclared ones to none."""
    truth = [(f, 1, 0, 0, True) for f in (*range(10), *range(100, 110))]
    claims = [(0, f, 1, 0, 0, 0.99, True) for f in range(10)]
    claims += [(0, 101, 1, 0, 0, 0.8, True), (0, 102, 3, 1, 0, 0.97, True)]
    claims += [(0, 103, 3, 1, 0, 0.99, False), (0, 104, 3, 1, 0, 0.6, True)]
    found = counts(matched(120, truth, claims)).parts[0].sums["claimed", "a"]
    of = {d: found[:, i].tolist() for i, d in enumerate(DECLARES)}
    assert of[0.99] == [[10, 0], [0, 0]]
    assert of[0.97] == [[10, 0], [0, 1]]
    assert of[0.75] == [[10, 0], [1, 1]]
    assert found[:, -1].tolist() == [[10, 0], [1, 2]]


def test_a_run_takes_the_bound_and_the_report_states_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("one", "two"):
        shutil.copy(SAMPLES / "pan.mcap", f"{name}.mcap")
        for file in ("sonar.toml", "gt.csv"):
            shutil.copy(SAMPLES / f"pan.{file}", f"{name}.{file}")
    sonarrec("run", "one.mcap", "-q")
    (bound_file,) = bounded = [Path("sonarrec_out/one/evaluation/bound.toml")]
    told = sonarrec("evaluate", "sonarrec_out/one", "--bound", "0.8")
    assert "declare 0.75: in the mean pass at most 0.8 of the claims are false" in told.stdout
    assert "bound.toml" in told.stdout
    sonarrec("run", "two.mcap", "--config", *bounded, "-q")
    table = tomllib.loads(Path("sonarrec_out/two/run.toml").read_text())
    assert table["bound"] == {"share": 0.8, "confidence": 0.95, "passes": 3, "false_share": 0.0}
    sonarrec("report", "sonarrec_out/two", "-o", "report.html")
    page = Path("report.html").read_text()
    assert "in the mean pass at most 0.8 of the claims are false" in page
    assert "for passes with the sonar, site and objects of these" in page
    # With other settings it does not hold.
    more = ("--set", "features.memory_frames=20", "-q")
    note = sonarrec("run", SAMPLES / "polar", "--config", *bounded, *more).stderr
    assert "its bound is not that of this run, which has another features.memory_frames" in note
    assert "bound" not in tomllib.loads(Path("sonarrec_out/polar/run.toml").read_text())
    fault = sonarrec("evaluate", "sonarrec_out", "--bound", "0.8", code=4).stderr
    assert "was run with another features.memory_frames than" in fault
    # Where it is refused an earlier one goes.
    fault = sonarrec("evaluate", "sonarrec_out/one", "--bound", "0.02", code=4).stderr
    assert "more passes like these would do" in fault
    assert not bound_file.exists()
