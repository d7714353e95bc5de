"""Writes the claims of a method as COCO: `sonarrec export --to coco`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sonarrec.drawing.results import outline_of
from sonarrec.errors import Diagnostics, SonarrecError
from sonarrec.readers import open_log
from sonarrec.results.folders import log_of
from sonarrec.results.read import choose_method, find_logs, read_estimates, read_frames
from sonarrec.results.run_file import LogOptions, cut_short, read_run, tables_changed
from sonarrec.runs.recorded import outdated, recorded_at
from sonarrec.sonar.frame import follows
from sonarrec.truth.coco import ImageObject, Pictures, pictures_of, write_coco
from sonarrec.truth.table import TRACKED


def export_coco(
    results: Sequence[Path], out: Path | None, method: str | None
) -> tuple[list[str], Diagnostics]:
    """Write the declared claims of one log as `out`, a new COCO file; of several each as
    `out`/LOG.json. (A line on each file, faults and notes.)

    out: None: coco.json, or the folder coco. method: None: the leading one. Raises SonarrecError if
    no log can be used, UsageError if the method is not there.
    """
    folders = [*dict.fromkeys(folder for path in results for folder in find_logs(path))]
    lines, diagnostics = list[str](), Diagnostics()
    for folder in folders:
        file = out or Path("coco.json")
        if folders[1:]:
            file = Path(out or "coco") / f"{log_of(folder)}.json"
        try:
            lines.append(_export(folder, file, method, diagnostics))
        except SonarrecError as error:
            if not lines and folder == folders[-1]:
                raise
            diagnostics.problem(f"{error}; not exported")
    return lines, diagnostics


def _export(folder: Path, out: Path, method: str | None, diagnostics: Diagnostics) -> str:
    """One log; a line on its file."""
    run, name = read_run(folder / "run.toml"), log_of(folder)
    landmarks, fan = run.landmark_set(), run.fan()
    if fan is None:
        raise SonarrecError(f"{run.path}: does not state the sonar's geometry; run again")
    try:
        options = run.complete(LogOptions(), same_log=True).arguments()
        with open_log(recorded_at(folder, run.input), **options) as log:
            pictures = pictures_of(log)
    except SonarrecError as error:
        pictures = Pictures(name, fan, run.sonar(), (fan.columns, fan.rows))
        diagnostics.note(f"{folder}: images are named by number, not as in the log ({error})")
    table, frames = folder / "estimates.csv", sorted(read_frames(folder)["frame"].tolist())
    method, objects, listed = choose_method(table, method), list[ImageObject](), {*frames}
    for frame, estimates in read_estimates(table, method, landmarks, fan):
        for e in estimates if frame in listed else ():
            attributes: dict[str, Any] = {"source": TRACKED}  # as truth they are unchecked
            if follows(method):
                attributes["track"] = str(e.object)
            if math.isfinite(e.orientation_deg):
                attributes["orientation_deg"] = e.orientation_deg
            if e.declared:
                shape = e.landmark, e.x_px, e.y_px, outline_of(e, fan, landmarks)
                objects.append(ImageObject(frame, *shape, attributes, e.score))
    line = f"{write_coco(out, landmarks, pictures, frames, objects)}, {method}"
    diagnostics.problem(*(f"{folder}: {fault}" for fault in tables_changed(folder, run.input)))
    if not run.finished:
        diagnostics.problem(cut_short(name, len(frames), "exported"))
    diagnostics.note(*outdated([folder]))
    return line
