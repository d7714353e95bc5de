"""Writes recordings into which landmarks were laid: images, geometry, truth and what was laid."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sonarrec.errors import SonarrecError
from sonarrec.files.outputs import write_csv, writing
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.simulation.background import Background, ComposedFrame, DiscLook, Layout, compose
from sonarrec.simulation.simulate import write_documents, write_image
from sonarrec.simulation.truth import TRUTH_COLUMNS, truth_rows
from sonarrec.sonar import Sonar


def check_free(folders: Sequence[Path]) -> None:
    """Raise SonarrecError if one of the folders exists and is not empty."""
    for folder in folders:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise SonarrecError(f"{folder}: already exists and is not empty; choose another --out")


def write_backgrounds(
    background: Background,
    layout: Layout,
    look: DiscLook,
    folders: Mapping[float, Path],
    step: Callable[[], None] | None = None,
) -> None:
    """Write a recording for each contrast: NNNNNN.png, sonar.toml, gt.csv and background.toml.

    poses.csv is written too if the motion comes from poses, and landmarks.toml if the set is not
    basin. folders: by contrast (dB); they must be empty or new. step: called after each frame.
    Raises SonarrecError if a folder is in use or cannot be written.
    """
    check_free([*folders.values()])
    with writing(", ".join(map(str, folders.values()))):
        for folder in folders.values():
            folder.mkdir(parents=True, exist_ok=True)
        _write_frames(compose(background, layout, look, [*folders]), folders, step)
        for db, folder in folders.items():
            document = _background_table(background, layout, look, db)
            _write_companions(folder, background, layout.landmarks, document)


def _write_frames(
    frames: Iterable[ComposedFrame], folders: Mapping[float, Path], step: Callable[[], None] | None
) -> None:
    """Write the images and gt.csv of every contrast, frame by frame. Raises OSError."""
    with ExitStack() as stack:
        tables = []
        for folder in folders.values():
            file = (folder / "gt.csv").open("w", newline="", encoding="utf-8")
            tables.append(csv.writer(stack.enter_context(file), lineterminator="\n"))
        for table in tables:
            table.writerow(TRUTH_COLUMNS)
        for frame in frames:
            for db, folder in folders.items():
                write_image(folder / f"{frame.index:06d}.png", frame.images[db])
            for table in tables:
                table.writerows(truth_rows(frame.index, frame.truth))
            if step:
                step()


def _write_companions(
    folder: Path, background: Background, landmarks: LandmarkSet, document: Mapping[str, Any]
) -> None:
    """Write what lies beside the images. document: background.toml. Raises OSError."""
    documents = {"background": document}
    if landmarks != load_landmarks("basin"):
        documents["landmarks"] = landmarks.as_table()
    if background.has_poses:
        _write_poses(folder / "poses.csv", background)
    # sonar.toml comes last: a folder without geometry is not taken for a whole recording.
    documents["sonar"] = {"sonar": _sonar(background).as_table()}
    write_documents(folder, documents)


def _sonar(background: Background) -> Sonar:
    """The geometry of the images written: fans, with the reader's grey levels."""
    fan = background.fan
    low, high = fan.bearing_min_deg, fan.bearing_max_deg
    even = math.isclose(-low, high, abs_tol=1e-9)
    quarter = (high - low) / 4
    return Sonar(
        layout="fan",
        range_min_m=fan.range_min_m,
        range_max_m=fan.range_max_m,
        field_of_view_deg=high - low if even else None,
        # Two beams whose outer edges are the fan's.
        bearings_deg=None if even else (low + quarter, high - quarter),
        tilt_deg=fan.tilt_deg,
        height_m=fan.height_m,
        frame_rate_hz=background.rate_hz,
        metres_per_pixel=fan.metres_per_pixel,
        apex_px=(fan.apex_column, fan.apex_row),
        pixel_scale="linear",
        dynamic_range_db=background.dynamic_range_db,
    )


def _write_poses(path: Path, background: Background) -> None:
    rows = (
        [round(n * 1e9 / background.rate_hz), *(round(v, 6) for v in (p.pan_deg, p.x_m, p.y_m))]
        for n, p in enumerate(background.path)
    )
    write_csv(path, ["timestamp_ns", "yaw", "x", "y"], rows)


def _background_table(
    background: Background, layout: Layout, look: DiscLook, contrast_db: float
) -> dict[str, Any]:
    """The tables of background.toml: how the recording was made, and where every disc lies."""
    first, end = background.span
    return {
        "background": {
            "log": background.where,
            "frames": f"{first}:{'' if end is None else end}",
            "landmark_set": layout.landmarks.name,
            "contrast_db": contrast_db,
            **asdict(look),
            "dynamic_range_db": background.dynamic_range_db,
            "seed": layout.seed,
            "motion": "told by poses" if background.has_poses else "measured between the images",
            "motion_unknown": background.unknown,
        },
        "disc": [
            {k: round(v, 5) if isinstance(v, float) else v for k, v in asdict(disc).items()}
            for disc in layout.discs
        ],
    }
