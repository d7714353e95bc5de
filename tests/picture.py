"""The README's picture: `python -m tests.picture` writes sample_data/picture.png.

Left, frames of the sample log with what the framework says on them; right, the probability of
each ID along the tracks, over the whole log.
"""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from sonarrec.config import preset
from sonarrec.landmarks import load_landmarks
from sonarrec.pipeline import process

SAMPLES = Path(__file__).resolve().parents[1] / "sample_data"
BUILD = SAMPLES.parent / "build" / "picture"
LOG = "pan"
SHOWN = (34, 100)
COLOURS = {1: "#56B4E9", 2: "#CC79A7", 3: "#E69F00", 4: "#009E73"}


def main() -> None:
    """Run the sample log and draw."""
    results = process(SAMPLES / LOG, BUILD, preset("default"))
    landmarks = load_landmarks("basin")
    with (results.folder / "estimates.csv").open(newline="", encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if r["method"] == "framework"]
    figure = Figure(figsize=(11, 3.9), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.9))
    for axes, number in zip(panels[:2], SHOWN, strict=True):
        image = cv2.imread(str(SAMPLES / LOG / f"{number:06d}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        radius = landmarks.radius_m / (2.5 / image.shape[0])
        for row in rows:
            if int(row["frame"]) != number:
                continue
            x, y = float(row["x_px"]), float(row["y_px"])
            named = row["declared"] == "1"
            colour = COLOURS[int(row["landmark"])] if named else "0.8"
            style = "-" if named else ":"
            axes.add_patch(
                Ellipse((x, y), 2.1 * radius, 2.0 * radius, fill=False, ec=colour, lw=2, ls=style)
            )
            if named:
                text = f"ID.{row['landmark']}  {float(row['score']):.2f}"
                axes.text(x, y - 1.25 * radius, text, color=colour, fontsize=9, ha="center")
        axes.set_title(f"frame {number}; dotted: none of these", fontsize=9)
        axes.set(xticks=[], yticks=[])
    axes = panels[2]
    frames = np.array([int(r["frame"]) for r in rows])
    tracks = np.array([int(r["object"]) for r in rows])
    for track in np.unique(tracks):
        mine = np.flatnonzero(tracks == track)
        if len(mine) < 5:
            continue
        sure = [float(rows[n]["p_none"]) for n in mine]
        axes.plot(frames[mine], sure, color="0.6", lw=1, ls=":")
        ids = [i for i in landmarks.ids if any(int(rows[n]["landmark"]) == i for n in mine)]
        for landmark in ids:
            belief = [float(rows[n][f"p_{landmark}"]) for n in mine]
            axes.plot(frames[mine], belief, color=COLOURS[landmark], lw=2)
    for landmark in (1, 3):
        axes.plot([], [], color=COLOURS[landmark], lw=2, label=f"ID.{landmark}")
    axes.plot([], [], color="0.6", ls=":", label="none of these")
    axes.set(title="probability along each track", xlabel="frame", ylim=(-0.02, 1.02))
    axes.grid(color="0.92")
    axes.legend(loc="center", bbox_to_anchor=(0.48, 0.5), fontsize=9)
    figure.savefig(SAMPLES / "picture.png")


if __name__ == "__main__":
    main()
