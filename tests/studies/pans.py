"""`make pans`: slow pans of a standing sonar, as measured between the images, added up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonarrec.config import preset
from sonarrec.recogniser.odometry import Odometry
from sonarrec.recogniser.plane import working_plane
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import SonarSection, load_scene, scene_fan

FRAMES = 41
VIEWS = ((28.8, 96, 0.4), (60.0, 256, 0.6), (130.0, 256, 1.0))
"""Field of view (deg), beams, their width (deg)."""
RATES = (0.4, 1.0, 2.0, 3.0, 5.0)  # deg/s, at 4 frames a second


def added_up(view: tuple[float, int, float], pan_deg_s: float) -> tuple[float, float, float]:
    """(turned in all, by how much the measured sum is off, its stated standard error), deg."""
    near = load_scene("basin")
    view_deg, beams, width_deg = view
    sonar = replace(
        SonarSection(), field_of_view_deg=view_deg, beams=beams, beam_width_deg=width_deg
    )
    motion = replace(
        near.motion, pan_min_deg=-60, pan_max_deg=60, pan_start_deg=-30, pan_deg_s=pan_deg_s
    )
    scene = replace(near, frames=FRAMES, sonar=sonar, motion=motion)
    settings, radius_m = preset("default"), near.landmark_set.radius_m
    select = settings.candidates
    plane = working_plane(select.plane, scene_fan(scene), radius_m, select.disc_radius_px)
    odometry = Odometry(plane, settings.continuity)
    turned, steps = [], []
    for frame in render(scene):
        turned.append(frame.pan_deg)
        if (step := odometry.step(plane.warp(frame.image), frame.timestamp_ns)) is not None:
            steps.append((step.pan_deg, step.pan_sigma_deg))
    pans, sigmas = np.array(steps).T
    whole = turned[-1] - turned[0]
    return whole, float(pans.sum() - whole), float(np.hypot.reduce(sigmas))


def main() -> None:
    """Print a line for each field of view and speed."""
    print(f"{FRAMES - 1} steps: field of view, deg a step; turned, measured less that, sigma (deg)")
    for view in VIEWS:
        for rate in RATES:
            whole, off, sigma = added_up(view, rate)
            print(f"  {view[0]:5.1f}  {rate / 4:.2f}  {whole:6.2f}  {off:+.3f}  {sigma:.3f}")


if __name__ == "__main__":
    main()
