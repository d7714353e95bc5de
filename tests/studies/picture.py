"""The README's pictures, sample_data/*.png: `python -m tests.studies.picture`.

landmarks.png: the built-in set, as drawn and cut out of the sample logs; picture.png: two frames of
a sample log as `sonarrec overlay` draws them; report.png: the top of its report, by Chromium;
clip.png: three frames of the real clip of an AcTag, where that is at hand (BSD-2, Brigham Young
University).
"""

from __future__ import annotations

import csv
import subprocess
from pathlib import Path

import cv2
import numpy as np

from sonarrec.config import preset
from sonarrec.landmarks import load_landmarks
from sonarrec.overlays.overlay import overlay
from sonarrec.readers import open_log
from sonarrec.reports.build import report
from sonarrec.runs.run import run as run_log

SAMPLES = Path(__file__).resolve().parents[2] / "sample_data"
BUILD = SAMPLES.parent / "build" / "picture"
LOG = SAMPLES / "pan"
SHOWN = (34, 100)
CELL_PX = 130
CUT_RADII = 1.3  # what is shown round a landmark's centre
CLIP = SAMPLES.parents[1] / "shared" / "data" / "actag" / "actag_first.mp4"
CLIP_SHOWN, CLIP_PX = (40, 120, 190), (310, 270)
REPORT_PX = (920, 800)
SEEN = {1: ("pan", 20), 2: ("polar", 20), 3: ("pan", 60), 4: ("polar", 60)}  # ID: log, frame


def draw_landmarks() -> np.ndarray:
    """(2 cells, one column per ID, 3): every landmark as drawn, and as a sample log shows it.

    As drawn it is turned to where it lies in the frame below it.
    """
    landmarks = load_landmarks("basin")
    right, down = np.meshgrid(*2 * (np.linspace(-CUT_RADII, CUT_RADII, CELL_PX),))
    columns = []
    for k, landmark in enumerate(landmarks.ids):
        name, number = SEEN[landmark]
        with (SAMPLES / name / "gt.csv").open(encoding="utf-8") as file:
            (row,) = [
                row
                for row in csv.DictReader(file)
                if (row["frame"], row["landmark"]) == (str(number), str(landmark))
            ]
        turn = np.deg2rad(float(row["orientation_deg"]))
        x = right * np.cos(turn) - down * np.sin(turn)
        y = -right * np.sin(turn) - down * np.cos(turn)
        bright = landmarks.pattern(k, x, y)
        drawn = np.where(np.hypot(x, y) <= 1, 70 + 160 * bright, 20).astype(np.uint8)
        with open_log(str(SAMPLES / name)) as log:
            frame = next(frame for frame in log if frame.index == number)
        side = round(2 * CUT_RADII * landmarks.radius_m / frame.fan.metres_per_pixel)
        place = (float(row["x_px"]), float(row["y_px"]))
        cut = cv2.getRectSubPix(frame.image, (side, side), place)
        seen = cv2.resize(cut, (CELL_PX, CELL_PX), interpolation=cv2.INTER_CUBIC)
        both = cv2.cvtColor(np.vstack([drawn, seen]), cv2.COLOR_GRAY2BGR)
        white = (255, 255, 255)
        cv2.putText(both, f"ID.{landmark}", (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, white, 1)
        columns.append(both)
    return np.hstack(columns)


def draw_report(results: Path, drawn: Path) -> None:
    """The top of the results' report."""
    page = BUILD / "report.html"
    report(results, page, logs=LOG)
    size = ",".join(map(str, REPORT_PX))
    options = ["--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={size}"]
    subprocess.run(["chromium", *options, f"--screenshot={drawn}", page.as_uri()], check=True)


def draw_clip() -> np.ndarray:
    """Three frames with what was recognised, without the probabilities below them."""
    results = run_log(CLIP, BUILD, landmarks="actag24h10", sonar={"range_order": "far_first"})
    images = BUILD / "clip"
    overlay(CLIP, images, results=results.folder)
    shown = []
    for number in CLIP_SHOWN:
        picture = cv2.imread(str(images / f"{number:06d}.png"))
        fan = picture[: round(picture.shape[1] * CLIP_PX[1] / CLIP_PX[0])]
        shown.append(cv2.resize(fan, CLIP_PX, interpolation=cv2.INTER_AREA))
    return np.hstack(shown)


def main() -> None:
    """Draw the landmarks; run the sample log; draw its results and its report."""
    assert cv2.imwrite(str(SAMPLES / "landmarks.png"), draw_landmarks())
    results = run_log(LOG, BUILD, preset=preset("default"))
    images = BUILD / "frames"
    overlay(LOG, images, results=results.folder)
    pictures = [cv2.imread(str(images / f"{number:06d}.png")) for number in SHOWN]
    between = np.full((len(pictures[0]), 8, 3), 255, np.uint8)
    assert cv2.imwrite(str(SAMPLES / "picture.png"), np.hstack([pictures[0], between, pictures[1]]))
    draw_report(results.folder, SAMPLES / "report.png")
    if CLIP.exists():
        assert cv2.imwrite(str(SAMPLES / "clip.png"), draw_clip())


if __name__ == "__main__":
    main()
