"""The motion that a run wrote to frames.csv, and the path that follows from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sonarrec.errors import SonarrecError
from sonarrec.files.outputs import write_csv, writing
from sonarrec.files.tables import Kind, Table, read_table
from sonarrec.mapping.path import SonarPath, measured_path

FRAMES = "frame,timestamp_ns,dx_m,dy_m,dyaw_deg,dx_sigma_m,dy_sigma_m,dyaw_sigma_deg"
MOVED = ("dyaw_deg", "dx_m", "dy_m")
MOVED_SIGMA = ("dyaw_sigma_deg", "dx_sigma_m", "dy_sigma_m")
"""Columns of frames.csv with the measured motion since the previous frame, and its standard errors:
turn to the right, shift to the right, shift ahead, in the axes of the previous frame."""
PATH_COLUMNS = ("timestamp_ns", "yaw", "x", "y", "yaw_sigma_deg", "x_sigma_m", "y_sigma_m")


def read_frames(folder: Path) -> Table:
    """frames.csv of a log's results, one row for each frame number, rising.

    Raises SonarrecError if it cannot be read or if no frame was processed.
    """
    kinds: dict[str, Kind] = {"frame": "whole", "timestamp_ns": "whole"}
    kinds |= dict.fromkeys((*MOVED, *MOVED_SIGMA), "blank or number")
    table = read_table(folder / "frames.csv", kinds, ("frame",), FRAMES)
    if not len(table["frame"]):
        raise SonarrecError(f"{folder}: no frame was processed")
    _, first = np.unique(table["frame"], return_index=True)
    return {name: column[first] for name, column in table.items()}


def measured_motion_path(folder: Path, table: Table) -> tuple[SonarPath, list[str]]:
    """(the path from the first frame on, notes on it). table: from `read_frames`.

    Raises SonarrecError if no motion was measured.
    """
    missing = [name for name in ("dyaw_deg", "dyaw_sigma_deg") if name not in table]
    if missing or not np.isfinite(table["dyaw_deg"]).any():
        reason = ", ".join(missing) or "dyaw_deg is empty"
        raise SonarrecError(
            f"{folder}: neither poses nor measured motion ({reason} in frames.csv); "
            "run the log with --odometry, or give it here"
        )
    notes = []
    if "dx_m" not in table or "dy_m" not in table:
        notes.append(f"{folder}: only the turn was measured; the sonar is taken to stand still")
    frame = table["frame"]
    still = np.zeros(len(frame))
    moved, sigma = (
        np.column_stack([table.get(name, still) for name in names])
        for names in (MOVED, MOVED_SIGMA)
    )
    time = table.get("timestamp_ns", np.zeros(len(still), np.int64))
    # Motion from poses has no standard errors.
    sigma = np.where(np.isfinite(moved), np.nan_to_num(sigma), np.nan)
    path = measured_path(frame, time, moved, sigma)
    unknown = ~np.isfinite(path.pose).all(axis=1)
    if unknown.any():
        notes.append(
            f"{folder}: the motion to frame {frame[np.argmax(unknown)]} is not known; what was "
            "seen from there on is not placed"
        )
    return path, notes


def write_path(folder: Path, out: Path) -> None:
    """Write the path in a log's results as a table that `sonarrec run --odometry` reads.

    Raises SonarrecError if no motion was measured, or if the table cannot be written.
    """
    table = read_frames(folder)
    if "timestamp_ns" not in table:
        raise SonarrecError(f"{folder}: frames.csv has no timestamp_ns, by which poses are told")
    path, _ = measured_motion_path(folder, table)
    row = np.flatnonzero(np.isfinite(path.pose).all(axis=1))
    pose = path.pose[row]
    place = path.place_covariance(row, pose[:, 1:])
    sigma = np.sqrt(
        np.maximum(np.column_stack([path.yaw_variance(row), place[:, 0, 0], place[:, 1, 1]]), 0)
    )
    rows = (
        [int(at), f"{yaw:.5f}", f"{x:.6f}", f"{y:.6f}", f"{a:.4f}", f"{b:.5f}", f"{c:.5f}"]
        for at, (yaw, x, y), (a, b, c) in zip(path.timestamp_ns[row], pose, sigma, strict=True)
    )
    with writing(out):
        write_csv(out, PATH_COLUMNS, rows)
