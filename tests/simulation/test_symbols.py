"""Symbols that are nobody's are that: at every turn they differ from every ID."""

from __future__ import annotations

import numpy as np
import pytest

from sonarrec.landmarks import load_landmarks
from sonarrec.simulation.objects import symbol
from sonarrec.simulation.scene import LEARNED_SYMBOLS, OTHER_SYMBOLS
from tests.studies.learning.random_scenes import random_scene
from tests.support.drawn import SECTORS, disc_pattern
from tests.support.slow import but_first

BASIN = load_landmarks("basin")
Y, X = np.mgrid[1:-1:61j, -1:1:61j]
WITHIN = np.hypot(X, Y) <= 0.98


@pytest.mark.parametrize("kind", but_first([*LEARNED_SYMBOLS, *OTHER_SYMBOLS]))
def test_a_symbol_is_unlike_every_id_at_every_turn(kind: str) -> None:
    scale = BASIN.symbol[1]
    for number in range(12):
        lit = symbol(kind, number, BASIN, X, Y)
        assert not lit[np.hypot(X, Y) > 1].any()
        assert 0.02 < lit[WITHIN].mean() < 0.98
        np.testing.assert_array_equal(lit, symbol(kind, number, BASIN, X, Y))
        for sectors in SECTORS.values():
            for turn in np.radians(np.arange(0, 360, 15)):
                id_ = disc_pattern(sectors, turn)(scale * X, scale * Y) > 0.5
                assert np.mean(lit[WITHIN] != id_[WITHIN]) > 0.08


def test_what_is_learned_from_and_what_never_is_have_no_symbol_in_common() -> None:
    def symbols(kind: str) -> set[str]:
        scenes = (random_scene(seed, kind) for seed in range(2900, 2906))
        return {o.kind for s in scenes for o in s.objects} & {*LEARNED_SYMBOLS, *OTHER_SYMBOLS}

    assert symbols("symbols") == set(LEARNED_SYMBOLS)
    assert symbols("other_symbols") <= set(OTHER_SYMBOLS)
