"""Recordings that were paused: others discs lie in the same places afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import tomli_w

from sonarrec.simulation.mcap import McapWriter
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import Scene, load_scene, scene_sonar
from sonarrec.simulation.truth import TRUTH_COLUMNS, truth_rows
from sonarrec.truth.table import write_truth

START_NS = int(datetime(2024, 10, 26, 12, tzinfo=UTC).timestamp()) * 10**9
PERIOD_NS = 250_000_000
IDS = {1: 2, 3: 4}
"""The IDs before each pause, and those in their places afterwards."""


def parts(frames: int, count: int, **motion: float) -> list[Scene]:
    """Scenes of equal motion whose landmarks change their IDs from one to the next."""
    scene = load_scene("sample_pan")
    assert isinstance(scene, Scene)
    still = {"pan_min_deg": -1.0, "pan_max_deg": 1.0, "pan_start_deg": -1.0, "pan_deg_s": 0.5}
    scene = replace(scene, frames=frames, motion=replace(scene.motion, **(still | motion)))
    others = tuple(replace(one, id=IDS[one.id]) for one in scene.landmarks)
    return [scene if n % 2 == 0 else replace(scene, landmarks=others) for n in range(count)]


def record(out: Path, scenes: Sequence[Scene], starts_ns: Sequence[int]) -> Path:
    """Write the scenes one after the other, each from its own time on, with geometry and truth.

    out: NAME.mcap, or a folder of images whose names have the times.
    """
    mcap, rows = out.suffix == ".mcap", list[list[object]]()
    writer = McapWriter(out, None) if mcap else None
    beside = f"{out.with_suffix('')}." if mcap else f"{out}/"
    if not mcap:
        out.mkdir(parents=True)
    index = 0
    for scene, start_ns in zip(scenes, starts_ns, strict=True):
        for frame in render(scene):
            time_ns = start_ns + frame.index * PERIOD_NS
            if writer is not None:
                writer.write(time_ns, frame.image)
            else:
                moment = datetime.fromtimestamp(time_ns // 10**9, UTC)
                name = f"{moment:%Y%m%dT%H%M%S}.{time_ns % 10**9 // 10**6:03d}.png"
                assert cv2.imwrite(str(out / name), frame.image)
            rows += truth_rows(index, frame.truth)
            index += 1
    if writer is not None:
        writer.__exit__(None)
    sonar = scene_sonar(scenes[0]).as_table()
    Path(f"{beside}sonar.toml").write_text(tomli_w.dumps({"sonar": sonar}))
    write_truth(Path(f"{beside}gt.csv"), TRUTH_COLUMNS, rows)
    return out


def paused(out: Path, *pauses_s: float, frames: int = 60, **motion: float) -> Path:
    """A recording with pauses of these lengths, each after so many frames."""
    starts = [START_NS]
    for pause_s in pauses_s:
        starts.append(starts[-1] + (frames - 1) * PERIOD_NS + round(pause_s * 1e9))
    return record(out, parts(frames, len(starts), **motion), starts)
