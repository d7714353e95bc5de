"""Writes simulated recordings with known truth: images or an MCAP, geometry, truth and scene."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.errors import SonarrecError, UsageError, local
from sonarrec.landmarks import load_landmarks
from sonarrec.results.columns import CORNERS
from sonarrec.simulation.plates import PlateScene, plate_scene, plate_sonar, render_plates
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import Scene, load_scene, scene_sonar, scene_table
from sonarrec.simulation.truth import TRUTH_COLUMNS, truth_rows
from sonarrec.sonar import Sonar
from sonarrec.tables.outputs import writing

PLATE_COLUMNS = ("frame", "landmark", "range_m", "bearing_deg", "visible", "orientation_deg")
COMPANIONS = ("gt.csv", "scene.toml", "sonar.toml", "landmarks.toml")
"""Files written beside the frames."""


def simulate(
    scene: str | Path | Scene | PlateScene = "paper",
    out: str | Path = "simulated",
    *,
    seed: int | None = None,
    frames: int | None = None,
    image_format: str = "png",
) -> Path:
    """Render a recording with known truth into `out`, and return it.

    scene: the name of a built-in one, a TOML file or a Scene. out: a new folder, or NAME.mcap.
    seed, frames: replace those of the scene. image_format: "png" or "mcap". Raises SonarrecError
    if the scene cannot be used, or if `out` cannot be written or is in use.
    """
    if isinstance(scene, str | Path):
        scene = plate_scene(scene) or load_scene(str(scene))
    chosen: Scene | PlateScene = scene
    chosen = replace(
        chosen,
        seed=chosen.seed if seed is None else seed,
        frames=chosen.frames if frames is None else frames,
    )
    write_recording(chosen, Path(local(out)), image_format)
    return Path(out)


def write_recording(
    scene: Scene | PlateScene,
    out: Path,
    image_format: str = "png",
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write frames, sonar.toml, gt.csv and scene.toml.

    out: an empty or new folder for NNNNNN.png or frames.mcap; or a file NAME.mcap, beside which
    NAME.sonar.toml, NAME.gt.csv and NAME.scene.toml are written. progress: called after each frame
    with the number of frames done. The messages of an MCAP of polar images state the sonar's
    geometry, and sonar.toml only the rest. Raises SonarrecError if `out` cannot be written or is in
    use.
    """
    from sonarrec.simulation.mcap import McapWriter

    if isinstance(scene, PlateScene):
        if image_format != "png":
            raise UsageError("recordings of plates are written as PNGs; give a folder, not an MCAP")
        _write_plates(scene, out, progress)
        return
    if image_format not in ("png", "mcap"):
        raise SonarrecError(f'image format must be "png" or "mcap", not {image_format!r}')
    single_file = out.suffix == ".mcap"
    if single_file and image_format != "mcap":
        raise UsageError(f"{out}: a name ending in .mcap needs --format mcap")
    sonar = scene_sonar(scene)
    geometry = sonar.complete(scene.name) if sonar.layout == "polar" else None
    if image_format == "mcap" and geometry is not None:  # its messages state the rest
        kept = ("tilt_deg", "height_m", "frame_rate_hz", "beam_width_deg")
        sonar = Sonar(**{key: getattr(sonar, key) for key in kept})
    folder, prefix = (out.parent, f"{out.stem}.") if single_file else (out, "")
    if single_file and out.is_dir():
        raise SonarrecError(f"{out}: is a folder; choose another --out")
    check_free(out, *(folder / f"{prefix}{name}" for name in COMPANIONS))
    frames = render(scene)
    first = next(frames)  # a scene that cannot be rendered leaves no folder behind
    documents = {"scene": scene_table(scene)}
    if scene.landmark_set != load_landmarks("basin"):
        documents["landmarks"] = scene.landmark_set.as_table()
    # Last: a folder without geometry is not taken for a whole recording.
    documents["sonar"] = {"sonar": sonar.as_table()}
    with writing(out), ExitStack() as stack:
        folder.mkdir(parents=True, exist_ok=True)
        table = open_table(stack, folder / f"{prefix}gt.csv", TRUTH_COLUMNS)
        mcap = None
        if image_format == "mcap":
            name = out if single_file else out / "frames.mcap"
            mcap = stack.enter_context(McapWriter(name, geometry))
        for frame in chain([first], frames):
            if mcap is None:
                write_image(out / f"{frame.index:06d}.png", frame.image)
            else:
                mcap.write(frame.timestamp_ns, frame.image)
            table.writerows(truth_rows(frame.index, frame.truth))
            if progress:
                progress(frame.index + 1)
        write_documents(folder, documents, prefix)


def _write_plates(scene: PlateScene, out: Path, progress: Callable[[int], None] | None) -> None:
    """As write_recording: polar images, near range first, and corners.csv as well."""
    check_free(out)
    with writing(out), ExitStack() as stack:
        out.mkdir(parents=True, exist_ok=True)
        truth = open_table(stack, out / "gt.csv", PLATE_COLUMNS)
        corners = open_table(stack, out / "corners.csv", ("frame", "landmark", *CORNERS))
        for frame in render_plates(scene):
            write_image(out / f"{frame.index:06d}.png", frame.image)
            for plate in frame.truth:
                row = [frame.index, *(getattr(plate, name) for name in PLATE_COLUMNS[1:])]
                truth.writerow([round(cell, 4) for cell in row])
                of_plate = np.round(plate.corners.ravel(), 4).tolist()
                corners.writerow([frame.index, plate.landmark, *of_plate])
            if progress:
                progress(frame.index + 1)
        sonar = {"sonar": plate_sonar(scene).as_table()}
        write_documents(out, {"landmarks": scene.landmark_set.as_table(), "sonar": sonar})


def check_free(*paths: Path) -> None:
    """Raise SonarrecError if one of these exists and is not an empty folder."""
    for path in paths:
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise SonarrecError(f"{path}: already exists and is not empty; choose another --out")


def open_table(stack: ExitStack, path: Path, columns: Sequence[str]) -> Any:
    """A writer of the rows of a CSV file, whose header is written. Raises OSError."""
    file = stack.enter_context(path.open("w", newline="", encoding="utf-8"))
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    return writer


def write_documents(folder: Path, documents: Mapping[str, Any], prefix: str = "") -> None:
    """Write each document as <prefix><name>.toml, in order. Raises OSError."""
    import tomli_w  # only writers of TOML need it

    for name, document in documents.items():
        text = tomli_w.dumps(document)
        (folder / f"{prefix}{name}.toml").write_text(text, encoding="utf-8", newline="")


def write_image(path: Path, image: ByteImage) -> None:
    """Write an image as a PNG. Raises OSError."""
    # Not by imwrite, which dies of names that are not UTF-8.
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
