"""Writes simulated recordings with known truth: images or an MCAP, geometry, truth and scene."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.random  # else imported while it draws, when a SIGTERM would be lost

from sonarrec.errors import SonarrecError, UsageError, refuse_url
from sonarrec.landmarks import load_landmarks
from sonarrec.results.columns import CORNERS
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import AnyScene, PlateScene, load_scene, scene_sonar, scene_table
from sonarrec.simulation.truth import TRUTH_COLUMNS, truth_rows
from sonarrec.sonar.stated import Sonar
from sonarrec.tables.outputs import check_distinct, filled_at_once, writing

PLATE_COLUMNS = ("frame", "landmark", *TRUTH_COLUMNS[4:])
COMPANIONS = ("gt.csv", "scene.toml", "sonar.toml", "landmarks.toml")
"""Files written with the frames."""


def simulate(
    scene: str | Path | AnyScene = "paper",
    out: str | Path = "simulated",
    *,
    seed: int | None = None,
    frames: int | None = None,
) -> Path:
    """Render a recording with ground truth: frames, sonar.toml, gt.csv and the scene itself.

    Parameters
    ----------
    scene : str, Path, Scene or PlateScene, default "paper"
        The name of a built-in scene, a TOML file, or a scene.
    out : str or Path, default "simulated"
        A new or empty folder for images, or NAME.mcap.
    seed : int, optional
        In place of that of the scene.
    frames : int, optional
        The number of frames, in place of that of the scene.

    Returns
    -------
    Path
        `out`.

    Raises
    ------
    SonarrecError
        The scene cannot be used, or `out` cannot be written or is in use.

    Examples
    --------
    >>> log = sonarrec.simulate("paper", "simulated", frames=3, seed=1)
    >>> sorted(path.name for path in log.iterdir())
    ['000000.png', '000001.png', '000002.png', 'gt.csv', 'scene.toml', 'sonar.toml']
    """
    chosen = load_scene(scene) if isinstance(scene, str | Path) else scene
    changed = {"seed": seed, "frames": frames}
    given: Any = {key: value for key, value in changed.items() if value is not None}
    write_recording(replace(chosen, **given), Path(refuse_url(out)))
    return Path(out)


def write_recording(
    scene: AnyScene, out: Path, progress: Callable[[int], None] | None = None
) -> int:
    """Write frames, sonar.toml, gt.csv and scene.toml; of plates corners.csv and no scene.toml.

    out: an empty or new folder for NNNNNN.png; or a file NAME.mcap, with which NAME.sonar.toml,
    NAME.gt.csv and NAME.scene.toml are written. progress: called after each frame with the number
    of frames done. The messages of an MCAP of polar images state the sonar's geometry, and
    sonar.toml only the rest. Returns how many rows gt.csv has. Raises SonarrecError if `out` cannot
    be written or is in use.
    """
    import tomli_w

    from sonarrec.simulation.mcap import McapWriter

    plates, mcap = isinstance(scene, PlateScene), out.suffix == ".mcap"
    if plates and mcap:
        raise UsageError("recordings of plates are written as PNGs; give a folder, not an MCAP")
    sonar = scene_sonar(scene)
    geometry = sonar.complete(scene.name) if sonar.layout == "polar" else None
    if mcap and geometry is not None:  # its messages state the rest
        kept = ("tilt_deg", "height_m", "frame_rate_hz", "beam_width_deg")
        sonar = Sonar(**{key: getattr(sonar, key) for key in kept})
    folder, prefix = (out.parent, f"{out.stem}.") if mcap else (out, "")
    for path in (out, *(folder / f"{prefix}{name}" for name in COMPANIONS)):
        if path.exists() and (mcap or not path.is_dir() or any(path.iterdir())):
            raise SonarrecError(f"{path}: already exists and is not empty; choose another --out")
    documents = {} if isinstance(scene, PlateScene) else {"scene": scene_table(scene)}
    if plates or scene.landmark_set != load_landmarks("basin"):
        documents["landmarks"] = scene.landmark_set.as_table()
    documents["sonar"] = {"sonar": sonar.as_table()}
    if mcap:
        check_distinct(out)
    frames, seen = render(scene), 0
    with writing(out), filled_at_once(folder) as new, ExitStack() as stack:

        def table(name: str, columns: Iterable[str]) -> Any:
            path = new / f"{prefix}{name}"
            file = stack.enter_context(path.open("w", newline="", encoding="utf-8"))
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            return writer

        truth = table("gt.csv", PLATE_COLUMNS if plates else TRUTH_COLUMNS)
        if plates:
            corners = table("corners.csv", ("frame", "landmark", *CORNERS))
        if mcap:
            messages = stack.enter_context(McapWriter(new / out.name, geometry))
        for frame in frames:
            seen += len(frame.truth)
            if mcap:
                messages.write(frame.timestamp_ns, frame.image)
            else:  # not by imwrite, which dies of names that are not UTF-8
                png = cv2.imencode(".png", frame.image)[1].tobytes()
                (new / f"{frame.index:06d}.png").write_bytes(png)
            if not plates:
                truth.writerows(truth_rows(frame.index, frame.truth))
            for plate in frame.truth if plates else ():
                assert plate.corners is not None
                truth.writerow([round(v, 4) for v in (frame.index, plate.landmark, *plate[3:7])])
                of_plate = np.round(plate.corners.ravel(), 4).tolist()
                corners.writerow([frame.index, plate.landmark, *of_plate])
            if progress:
                progress(frame.index + 1)
        for name, document in documents.items():
            text = tomli_w.dumps(document)
            (new / f"{prefix}{name}.toml").write_text(text, encoding="utf-8", newline="")
    return seen
