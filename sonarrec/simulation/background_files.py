"""Writes recordings with discs composited into them: images, geometry, truth and the discs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sonarrec.arrays import ByteImage
from sonarrec.landmarks import load_landmarks
from sonarrec.simulation.background import Background
from sonarrec.simulation.composite import Composer
from sonarrec.simulation.layout import Layout, truth_of
from sonarrec.simulation.simulate import check_free, open_table, write_documents, write_image
from sonarrec.simulation.truth import TRUTH_COLUMNS, truth_rows
from sonarrec.sonar import Sonar
from sonarrec.tables.outputs import write_csv, writing


@dataclass(frozen=True, slots=True)
class DiscLook:
    """How discs look at any contrast: the level of their plates above the floor, and the width of
    the beams that smear them."""

    plate_db: float
    beam_width_deg: float


def compose(
    background: Background, layout: Layout, look: DiscLook, contrasts: Sequence[float]
) -> Iterator[tuple[int, dict[float, ByteImage]]]:
    """Yield (number, image with the discs of a layout by contrast) of the recording's frames.

    contrasts: levels of ring and sectors above the floor, dB.
    """
    scales = background.dynamic_range_db, look.beam_width_deg
    composer = Composer(background.fan, layout.landmarks, *scales)
    for frame in background.frames():
        pose = background.path[frame.index]
        images = composer.compose(frame.image, layout.discs, pose, contrasts, look.plate_db)
        yield frame.index, images


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
    check_free(*folders.values())
    poses = [
        [round(n * 1e9 / background.rate_hz), *(round(v, 6) for v in (p.pan_deg, p.x_m, p.y_m))]
        for n, p in enumerate(background.path)
    ]
    with writing(", ".join(map(str, folders.values()))), ExitStack() as stack:
        tables = []
        for folder in folders.values():
            folder.mkdir(parents=True, exist_ok=True)
            tables.append(open_table(stack, folder / "gt.csv", TRUTH_COLUMNS))
        for index, images in compose(background, layout, look, [*folders]):
            for db, folder in folders.items():
                write_image(folder / f"{index:06d}.png", images[db])
            for table in tables:
                table.writerows(truth_rows(index, truth_of(background, layout, index)))
            if step:
                step()
        for db, folder in folders.items():
            documents = _background_tables(background, layout, look, db)
            if layout.landmarks != load_landmarks("basin"):
                documents["landmarks"] = layout.landmarks.as_table()
            if background.has_poses:
                write_csv(folder / "poses.csv", ["timestamp_ns", "yaw", "x", "y"], poses)
            # Last: a folder without geometry is not taken for a whole recording.
            documents["sonar"] = {"sonar": _sonar(background, look.beam_width_deg).as_table()}
            write_documents(folder, documents)


def _sonar(background: Background, beam_width_deg: float) -> Sonar:
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
        beam_width_deg=beam_width_deg,
        metres_per_pixel=fan.metres_per_pixel,
        apex_px=(fan.apex_column, fan.apex_row),
        pixel_scale="linear",
        dynamic_range_db=background.dynamic_range_db,
    )


def _background_tables(
    background: Background, layout: Layout, look: DiscLook, contrast_db: float
) -> dict[str, Any]:
    """The document background.toml: how the recording was made, and where every disc lies."""
    first, end = background.span
    about = {
        "log": background.where,
        "frames": f"{first}:{'' if end is None else end}",
        "landmark_set": layout.landmarks.name,
        "contrast_db": contrast_db,
        **asdict(look),
        "dynamic_range_db": background.dynamic_range_db,
        "seed": layout.seed,
        "motion": "told by poses" if background.has_poses else "measured between the images",
        "motion_unknown": background.unknown,
    }
    discs = [
        {k: round(v, 5) if isinstance(v, float) else v for k, v in asdict(disc).items()}
        for disc in layout.discs
    ]
    return {"background": {"background": about, "disc": discs}}
