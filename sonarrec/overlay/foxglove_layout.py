"""A layout for Foxglove: the recording with its annotations, and the detections beside it."""

from __future__ import annotations

import json
from pathlib import Path

from sonarrec.overlay.foxglove_mcap import ANNOTATIONS_TOPIC, DETECTIONS_TOPIC
from sonarrec.tables.outputs import write_text, writing

_IMAGE = "Image!sonarrec"
LAYOUT_BEGIN = f'{{\n  "configById": {{\n    "{_IMAGE}": '
"""How a layout written by this program begins."""


def write_layout(path: Path, image_topic: str) -> None:
    """Write the layout as JSON. image_topic: of the recording, or of the fan in the overlay.

    Raises SonarrecError where the file cannot be written.
    """
    table, plot = "Table!sonarrec", "Plot!sonarrec"
    layout = {
        "configById": {
            _IMAGE: {
                "imageMode": {
                    "imageTopic": image_topic,
                    "annotations": {ANNOTATIONS_TOPIC: {"visible": True}},
                    "synchronize": True,
                },
            },
            table: {"topicPath": f"{DETECTIONS_TOPIC}.detections[:].results[:].hypothesis"},
            plot: {
                "title": "score of what is declared",
                "paths": [
                    {
                        "value": f"{DETECTIONS_TOPIC}.detections[:].results[:].hypothesis.score",
                        "enabled": True,
                        "timestampMethod": "receiveTime",
                        "showLine": False,
                    }
                ],
                "minYValue": 0,
                "maxYValue": 1,
                "xAxisVal": "timestamp",
                "showLegend": False,
            },
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _IMAGE,
            "second": {"direction": "column", "first": table, "second": plot},
            "splitPercentage": 65,
        },
    }
    with writing(path):
        write_text(path, json.dumps(layout, indent=2) + "\n")
