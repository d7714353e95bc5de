"""What the report gathers of a log, against loops: truth and estimates beside tracks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sonarrec.reports.logs import alongside, tracks
from tests.support.pages import random_results, reported


@pytest.fixture(scope="module")
def random_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_results(tmp_path_factory.mktemp("random") / "log")


def test_truth_beneath_and_estimates_alongside(random_log: Path) -> None:
    """Against loops over every pair."""
    log = reported(random_log)
    found, truth = log.results, log.matched
    assert truth is not None
    assert log.truth_near is not None
    assert found.position is not None
    for n in range(0, len(found.frame_index), 7):
        best, beneath = found.landmarks.radius_m, -1
        for t in np.flatnonzero(truth.truths["at"] == found.frame_index[n]):
            place = truth.truths["x"][t], truth.truths["y"][t]
            away = np.linalg.norm(found.position[n] - place)
            if away <= best:
                best, beneath = away, truth.truths["cell"][t] % len(truth.ids)
        assert log.truth_near[n] == beneath
    shown = tracks(log)
    assert {track.number for track in shown} == {100, 101, 102, 103}
    smi = np.flatnonzero(log.of_method("smi"))
    for track in shown:
        assert (np.diff(track.frame_index) > 0).all()
        assert (found.object[track.estimates] == track.number).all()
        for at, row, matched in zip(
            track.estimates, track.frame_index, alongside(log, track, "smi"), strict=True
        ):
            here = smi[found.frame_index[smi] == row]
            away = np.linalg.norm(found.position[here] - found.position[at], axis=1)
            if len(here) and away.min() <= found.landmarks.radius_m:
                assert matched == here[away.argmin()]
            else:
                assert matched == -1
