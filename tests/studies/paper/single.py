"""What a method says of a recording, kept in memory, and its counts as the paper counts.

The search for worlds and the choices need nothing else; tests hold it against the program.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, FloatImage, IntArray
from sonarrec.config import Candidates
from sonarrec.evaluation.match import PAPER_MIN_VISIBLE
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler, turned_codes
from sonarrec.recogniser.stage3.smi import identify
from sonarrec.simulation.render import SimulatedFrame, render
from sonarrec.simulation.scene import Scene, scene_fan
from tests.studies.paper.published import IDS
from tests.studies.paper.world import FAKE, FAKES, STRAY

HALF, WHOLE = PAPER_MIN_VISIBLE, 0.9
"""Shares of a disc inside the fan: from HALF on it is in view."""
NEAR_PX = 30.0
"""How near to a thing's centre what is found of it lies: half a disc diameter."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What a method says of n objects in F frames."""

    visible: FloatArray
    """(F, K) share of each landmark inside the fan."""
    frame: IntArray
    """(n,) into visible."""
    on: IntArray
    """(n,) the part of the world it lies on, of PARTS."""
    rank: IntArray
    """(n,) among its frame's."""
    inside: FloatArray
    """(n,) share of its disc inside the fan."""
    found: FloatArray
    """(n,) score of the candidate in stage 1."""
    score: FloatArray
    """(n,) of the claim."""
    q: FloatArray
    """(n, K) probabilities, or normalised similarities."""

    def cells(self, claim: BoolArray) -> IntArray:
        """(F, K) how often each ID is claimed in each frame. claim: (n,) which are claims."""
        claimed = np.zeros(self.visible.shape, int)
        np.add.at(claimed, (self.frame[claim], self.q[claim].argmax(axis=1)), 1)
        return claimed

    def rates(self, claim: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(K + 1,) TPR and FPR of the IDs and in total, as in Tables 4 and 5.

        Each further claim of an ID in view is one more TP; half a disc in view is a positive.
        """
        claimed, there = self.cells(claim), self.visible >= HALF
        counts = [claimed * there, there & (claimed == 0), ~there & (claimed > 0), ~there]
        tp, fn, fp, negative = (np.append(c.sum(axis=0), c.sum()) for c in counts)
        with np.errstate(invalid="ignore"):
            return tp / (tp + fn), fp / negative

    def false(self, k: int, claim: BoolArray) -> BoolArray:
        """(n,) which are false claims of the k-th ID."""
        return claim & (self.q.argmax(axis=1) == k) & (self.visible[self.frame, k] < HALF)

    def part(self, part: int) -> Seen:
        """What is said of one part of the world, of PARTS."""
        visible = np.zeros_like(self.visible)
        if part in range(len(IDS)):
            visible[:, part] = self.visible[:, part]
        return Seen(visible, *(getattr(self, f.name)[self.on == part] for f in fields(self)[1:]))

    def similarities(self) -> FloatArray:
        """(K, K) mean q on each landmark that is whole in view, rows = true ID; else NaN."""
        rows = np.full((len(IDS), len(IDS)), np.nan)
        for k in range(len(IDS)):
            mine = (self.on == k) & (self.visible[self.frame, k] >= WHOLE)
            if mine.any():
                rows[k] = self.q[mine].mean(axis=0)
        return rows


def joined(parts: Sequence[Seen]) -> Seen:
    """Parts of worlds as one world: their frames are the same."""
    visible = np.max([p.visible for p in parts], axis=0)
    names = [f.name for f in fields(Seen)[1:]]
    return Seen(visible, *(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def chained(logs: Sequence[Seen]) -> Seen:
    """Recordings one after another."""
    start = np.cumsum([0, *(len(s.visible) for s in logs)])
    frame = [s.frame + n for s, n in zip(logs, start, strict=False)]
    rest = [np.concatenate([getattr(s, f.name) for s in logs]) for f in fields(Seen)[2:]]
    return Seen(np.concatenate([s.visible for s in logs]), np.concatenate(frame), *rest)


@dataclass(slots=True)
class Log:
    """Takes in what a method says frame by frame."""

    disc_share: FloatImage
    """Of Plane."""
    visible: list[FloatArray] = field(default_factory=list)
    rows: list[FloatArray] = field(default_factory=list)

    def add(
        self,
        frame: SimulatedFrame,
        positions: FloatArray,
        found: FloatArray,
        score: FloatArray,
        q: FloatArray,
    ) -> None:
        """positions: (n, 2) pixels of the fan. found, score, q: as in Seen."""
        share = np.zeros(len(IDS))
        things = [(t.x_px, t.y_px, FAKE) for t in frame.distractors if t.kind in FAKES]
        for t in frame.truth:
            share[IDS.index(t.landmark)] = t.visible
            things.append((t.x_px, t.y_px, IDS.index(t.landmark)))
        places = np.array(things, float).reshape(-1, 3)
        away = np.linalg.norm(positions[:, None] - places[None, :, :2], axis=2)
        away = np.column_stack([away, np.full(len(positions), NEAR_PX)])
        on = np.append(places[:, 2], STRAY)[away.argmin(axis=1)]
        column, row = np.rint(positions).astype(int).T
        rows, columns = self.disc_share.shape
        inside = self.disc_share[row.clip(0, rows - 1), column.clip(0, columns - 1)]
        n = len(positions)
        number = np.full(n, len(self.visible))
        self.visible.append(share)
        self.rows.append(np.column_stack([number, on, np.arange(n), inside, found, score, q]))

    def seen(self) -> Seen:
        """All of it."""
        table = np.concatenate(self.rows)
        whole = table[:, :3].astype(int).T
        return Seen(np.array(self.visible), *whole, *table[:, 3:6].T, table[:, 6:])


def look(scene: Scene, every: int, settings: Sequence[Candidates]) -> list[Seen]:
    """SMI over each `every`-th frame, with the candidates of each of several settings."""
    fan, landmarks = scene_fan(scene), scene.landmark_set
    plane = working_plane("fan", fan, landmarks.radius_m, 1.0)
    width = usual_beam_width_deg(fan)
    selectors = [CandidateSelector(s, plane, landmarks, width) for s in settings]
    logs = [Log(plane.disc_share()) for _ in settings]
    sampler, turned = ShapeSampler(landmarks, plane.axes), turned_codes(landmarks)
    for frame in render(scene, every=every):
        for select, log in zip(selectors, logs, strict=True):
            chosen = select(frame.image)
            at = chosen.positions
            levels = select.levels(chosen, at)
            grey, seen = sampler(frame.image, plane.inside, at, plane.line_of_sight(at), *levels)
            said = identify(grey, seen, sampler.bands, turned)
            log.add(frame, at, chosen.scores, said.score, said.measurement())
    return [log.seen() for log in logs]
