"""How what a track's frames say is pooled; what hindsight spreads, and over which of its frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sonarrec.config import preset, with_assignments
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.presets.hindsight import Hindsight
from sonarrec.recogniser.stage3.opinions import (
    FRAME_EXPONENT,
    LEAST_BELIEF,
    LEAST_FRAME_BELIEF,
    TRACK_EXPONENT,
    Opinion,
    pooled,
)
from sonarrec.sonar.frame import Estimate, FrameResult

IDS = 4
said = arrays(float, (6, IDS + 1), elements=st.floats(0.0, 1.0)).map(
    lambda a: (a + 1e-6) / (a + 1e-6).sum(axis=1, keepdims=True)
)


@given(said)
def test_the_pool_is_the_weighted_geometric_mean_so_far(frames: np.ndarray) -> None:
    """Against the formula, written out with a product and a power for each frame."""
    found = pooled([Opinion()] * 6, frames)
    for i in range(6):
        floored = np.maximum(frames[: i + 1], LEAST_BELIEF)
        sure = np.prod(floored**floored, axis=1) ** 2
        weight = sure * np.arange(1, i + 2)
        so_far = np.prod(floored ** (weight / weight.sum())[:, None], axis=0)
        expected = (
            np.maximum(frames[i], LEAST_FRAME_BELIEF) ** FRAME_EXPONENT * so_far**TRACK_EXPONENT
        )
        np.testing.assert_allclose(found[i], expected / expected.sum(), atol=1e-12)


@given(said, st.integers(1, 5))
def test_the_same_whatever_frames_come_together(frames: np.ndarray, first: int) -> None:
    whole = pooled([Opinion()] * 6, frames)
    opinion = Opinion()
    parts = [pooled([opinion] * len(some), some) for some in (frames[:first], frames[first:])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@given(said)
def test_one_that_continues_two_has_the_frames_of_both(frames: np.ndarray) -> None:
    """As soon as a frame is added: till then those of both may still be waiting."""
    old, new = Opinion(), Opinion()
    both = Opinion(old, new)
    pooled([old, old, new, new, new], frames[:5])
    pooled([both], frames[5:])
    assert both.frames == 6
    np.testing.assert_allclose(both.beliefs, frames.sum(axis=0))
    assert both.weight > old.weight + new.weight


BASIN = load_landmarks("basin")
SURE = np.array([0.004, 0.002, 0.98, 0.004, 0.01])  # of the third ID
NONE = np.array([0.002, 0.002, 0.002, 0.004, 0.99])
UNSURE = np.array([0.1, 0.1, 0.5, 0.1, 0.2])


def result(frame: int, episode: int, beliefs: np.ndarray) -> FrameResult:
    """A frame in which track 7 is seen, in an episode of its life."""
    best = int(beliefs[:-1].argmax())
    score = float(beliefs[best])
    place = (10.0, 10.0, 2.0, 0.0, 0.0, 0.9)
    estimate = Estimate(
        "m", 7, *place, beliefs, BASIN.ids[best], score, score > 0.75, episode=episode
    )
    return FrameResult(frame, frame * 10**8, 1, 1, (estimate,))


def revised(frames: list[FrameResult]) -> list[Estimate]:
    config = with_assignments(preset("offline"), ["features.declare=0.75"])  # as `result` has it
    hindsight = Hindsight("m", config, BASIN)
    for frame in frames:
        hindsight.learn(frame)
    return [hindsight.revised(frame).estimates[0] for frame in frames]


def test_one_belief_for_all_frames_of_a_episode() -> None:
    found = revised([result(i, 1, UNSURE if i < 4 else SURE) for i in range(12)])
    assert len({tuple(e.probabilities) for e in found}) == 1
    assert all(e.declared and e.landmark == 3 for e in found)


@pytest.mark.parametrize("denying", [3, 9])
def test_what_most_frames_deny_is_not_spread_over_them(denying: int) -> None:
    """The later frames weigh more in the pool: by it alone the ID would be declared in all."""
    frames = [result(i, 1, NONE if i < denying else SURE) for i in range(16)]
    declared = [e.declared for e in revised(frames)]
    assert declared == ([True] * 16 if denying == 3 else [False] * 9 + [True] * 7)


@pytest.mark.parametrize(("declaring", "unable"), [(4, 0), (4, 8), (5, 0)])
def test_an_id_that_few_of_the_frames_declared_is_added_in_none(declaring, unable) -> None:
    """Those in which too little was seen to declare any ID do not count. By the pool alone it would
    be declared in all."""
    frames = [result(i, 1, UNSURE if i < 20 - declaring else SURE) for i in range(20)]
    for i in range(unable):
        (estimate,) = frames[i].estimates
        frames[i] = replace(frames[i], estimates=(replace(estimate, enough_evidence=False),))
    declared = [e.declared for e in revised(frames)]
    assert declared == ([True] * 20 if declaring > 4 or unable else [False] * 16 + [True] * 4)


@pytest.mark.parametrize("declaring", [6, 10])
def test_what_most_frames_declared_is_not_taken_back(declaring: int) -> None:
    """The later frames weigh more in the pool, which denies the ID either way."""
    frames = [result(i, 1, SURE if i < declaring else NONE) for i in range(18)]
    declared = [e.declared for e in revised(frames)]
    assert declared == [declaring == 10 and i < declaring for i in range(18)]


def test_nothing_is_declared_while_too_little_is_in_view() -> None:
    """As of the frame alone: what comes in is followed from where it first shows."""
    frames = [result(i, 1, SURE) for i in range(12)]
    (first,) = frames[0].estimates
    frames[0] = replace(frames[0], estimates=(replace(first, in_view=False, declared=False),))
    found = revised(frames)
    assert [e.declared for e in found] == [False] + [True] * 11
    assert len({tuple(e.probabilities) for e in found}) == 1


@pytest.mark.parametrize("second", [1, 2])
def test_another_object_that_took_up_the_number_is_a_episode_of_its_own(second: int) -> None:
    """Held for one life, the twenty frames that come later would outweigh the six before."""
    frames = [result(i, 1, SURE) for i in range(6)]
    frames += [result(40 + i, second, NONE) for i in range(20)]
    found = revised(frames)
    assert all(e.declared for e in found[:6]) == (second == 2)
    assert not any(e.declared for e in found[6:])
