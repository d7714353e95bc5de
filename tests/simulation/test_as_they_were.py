"""Scenes and kinds older than some of the simulator's abilities stay as they were; symbols that are
nobody's differ from every ID."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sonarrec.landmarks import load_landmarks
from sonarrec.simulation.objects import symbol
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import (
    LEARNED_SYMBOLS,
    OTHER_SYMBOLS,
    MultipathSection,
    Scene,
    load_scene,
    scene_from_table,
    scene_table,
)
from tests.studies.learning.other_worlds import LEARNED_WORLDS, OTHER_WORLDS
from tests.studies.learning.random_scenes import ALL_KINDS, KINDS_OF_SCENE, random_scene
from tests.support.drawn import SECTORS, disc_pattern
from tests.support.slow import but_first

NEW = ("slope", "leaning", "silted", "ripples", "multipath", "fish", "vehicle", "glitter")
# Mean grey of the middle eight of four by four parts of the second frame, before there were slopes,
# leaning or silted discs, ripples, multipath, fish, vehicles and glitter; of plates as they are.
WERE = {
    "basin": (47.98, 48.83, 62.64, 65.35, 76.67, 83.93, 61.84, 62.27),
    "all_hard": (36.69, 39.67, 45.62, 42.38, 47.40, 46.80, 38.46, 36.69),
    "relief": (81.48, 94.80, 93.24, 95.51, 111.27, 104.53, 84.32, 79.73),
    "plates": (68.32, 94.16, 82.34, 92.20, 103.69, 107.96, 99.16, 88.68),
    "other_symbols": (21.90, 25.09, 39.37, 37.54, 55.27, 50.97, 52.19, 48.43),
}


def parts(scene: Scene) -> np.ndarray:
    *_, frame = render(replace(scene, frames=2))
    image = frame.image.astype(np.float32)
    return np.asarray(cv2.resize(image, (4, 4), interpolation=cv2.INTER_AREA))[:, 1:3].ravel()


@pytest.mark.parametrize("name", WERE)
def test_older_scenes_render_as_they_did(name: str) -> None:
    scene = random_scene(7, name) if name in ALL_KINDS else load_scene(name)
    # Another draw of speckle alone moves these by whole levels; other processors round otherwise.
    np.testing.assert_allclose(parts(scene), WERE[name], atol=0.02)


def test_kinds_keep_their_numbers() -> None:
    assert ALL_KINDS[:3] == ("plain", "low_contrast", "window_1_25")
    assert ALL_KINDS.index("other_symbols") == 21
    assert ALL_KINDS[22:] == NEW
    assert set(LEARNED_WORLDS) <= set(OTHER_WORLDS)
    assert set(NEW) - set(LEARNED_WORLDS) == {"slope", "silted", "multipath"}


@pytest.mark.parametrize("kind", but_first([*NEW, *KINDS_OF_SCENE], 2))
def test_every_kind_has_its_nuisance_and_renders(kind: str) -> None:
    scenes = [random_scene(seed, kind, frames=2) for seed in (3, 4)]
    for scene in scenes:
        assert scene_from_table(scene_table(scene), kind) == scene
        discs = [*scene.landmarks, *(o for o in scene.objects if o.kind in ("blank", "filled"))]
        shows = {
            "slope": scene.floor.slope_deg > 0,
            "leaning": all(disc.lean_deg > 0 for disc in discs),
            "silted": all(disc.silted > 0 for disc in discs),
            "ripples": scene.floor.ripple_height_m > 0,
            "multipath": scene.multipath != MultipathSection(),
            "fish": scene.fish.number > 0,
            "vehicle": scene.motion.speeds.any(),
            "glitter": scene.floor.glitter_db > 0,
        }
        assert [name for name, shown in shows.items() if shown] == [kind] * (kind in NEW)
        assert bool(scene.landmarks) == (kind != "no_landmark")
        assert {"blank", "filled"} & {o.kind for o in scene.objects}
    assert scenes[0] == random_scene(3, kind, frames=2)
    frames = list(render(scenes[0]))
    again = list(render(scenes[0]))
    np.testing.assert_array_equal(frames[1].image, again[1].image)
    inside = frames[1].image[frames[1].image > 0]
    assert 20 < inside.mean() < 200
    assert inside.std() > 8


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
