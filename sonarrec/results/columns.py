"""The columns of frames.csv and estimates.csv."""

from __future__ import annotations

from collections.abc import Sequence

FRAME_COLUMNS = (
    "frame",
    "timestamp_ns",
    "candidates",
    "tracks",
    "log_time_ns",
    "publish_time_ns",
    "header_stamp_ns",
)


def estimate_columns(ids: Sequence[int]) -> list[str]:
    """The header of estimates.csv for a landmark set's IDs."""
    place = ["x_px", "y_px", "range_m", "bearing_deg", "orientation_deg", "existence"]
    beliefs = [f"p_{i}" for i in ids] + ["p_none"]
    return [
        "frame",
        "timestamp_ns",
        "method",
        "object",
        *place,
        *beliefs,
        "landmark",
        "score",
        "declared",
        "range_sigma_m",
        "bearing_sigma_deg",
        "orientation_sigma_deg",
    ]
