"""sonarrec: recognise landmarks in recorded imaging-sonar logs.

What a program or a notebook uses is here: functions of the rooms, each loaded when it is first
asked for. Paths may be texts or Path objects. `sonarrec help python` is a page of examples.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sonarrec.api.evaluate import compare, evaluate
    from sonarrec.api.run import run
    from sonarrec.config import preset
    from sonarrec.landmarks import load_landmarks
    from sonarrec.mapping.write import map_landmarks
    from sonarrec.overlays.overlay import overlay
    from sonarrec.readers import open_log
    from sonarrec.reports.build import report
    from sonarrec.results.read import read_results
    from sonarrec.runs.run import Recogniser
    from sonarrec.simulation.simulate import simulate

# Stated here, because looking it up in the installed package takes longer than loading click.
__version__ = "0.2.0"
# OpenCV reads this when it is loaded: it refuses image files whose headers state more than
# 4096 x 4096 pixels, before it allocates them.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**24))
# numpy's BLAS reads this when it is loaded: with more threads it would split sums among them, which
# changes the last digits. Products as small as ours gain nothing from threads.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

_HOMES = {
    "Recogniser": "runs.run",
    "compare": "api.evaluate",
    "evaluate": "api.evaluate",
    "load_landmarks": "landmarks",
    "map_landmarks": "mapping.write",
    "open_log": "readers",
    "overlay": "overlays.overlay",
    "preset": "config",
    "read_results": "results.read",
    "report": "reports.build",
    "run": "api.run",
    "simulate": "simulation.simulate",
}
__all__ = [
    "Recogniser",
    "__version__",
    "compare",
    "evaluate",
    "load_landmarks",
    "map_landmarks",
    "open_log",
    "overlay",
    "preset",
    "read_results",
    "report",
    "run",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
