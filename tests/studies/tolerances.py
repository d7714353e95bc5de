"""`python -m tests.studies.tolerances`: what wrong statements cost on the sample logs (minutes).

In each row one statement is wrong by a factor: the sonar's height, or a length of the landmark set.
The cells are TPR / FPR, protocol strict. The samples are easy recordings: harder ones lose more.
"""

from __future__ import annotations

import tempfile
import tomllib
from functools import partial
from pathlib import Path

import tomli_w

import sonarrec
from sonarrec.landmarks import load_landmarks
from tests.studies.results.record import SAMPLES, options, show
from tests.support.simulated import in_processes

LOGS = "pan", "polar", "faint"
WRONG = (
    ("height", (0.6, 0.8, 1.0, 1.2, 1.5)),
    ("radius", (0.9, 0.95, 1.05, 1.1)),
    ("inner edge of the ring", (0.9, 0.95, 1.05, 1.1)),
    ("outer edge of the symbol", (0.85, 1.15)),
)


def rates(log: str, what: str, factor: float, frames: tuple[int, int | None] = (0, None)) -> str:
    """TPR / FPR of a sample log whose statement is wrong by a factor."""
    discs, by = load_landmarks("basin"), {name: 1.0 for name, _ in WRONG} | {what: factor}
    ids = zip(discs.ids, discs.sectors, strict=True)
    ring = [discs.ring[0] * by["inner edge of the ring"], discs.ring[1]]
    symbol = [discs.symbol[0], discs.symbol[1] * by["outer edge of the symbol"]]
    stated = {"name": "stated", "radius_m": discs.radius_m * by["radius"]}
    stated |= {"ring": ring, "symbol": symbol}
    stated["landmark"] = [{"id": landmark, "sectors": [*sectors]} for landmark, sectors in ids]
    sonar = tomllib.loads((SAMPLES / log / "sonar.toml").read_text(encoding="utf-8"))["sonar"]
    height = {"height_m": sonar["height_m"] * by["height"]}
    with tempfile.TemporaryDirectory() as folder:
        landmarks = Path(folder, "stated.toml")
        landmarks.write_text(tomli_w.dumps(stated), encoding="utf-8")
        out = Path(folder, "results")
        sonarrec.run(SAMPLES / log, out, landmarks=landmarks, sonar=height, frames=frames)
        found = sonarrec.evaluate(out, SAMPLES / log / "gt.csv").table.loc["framework"]
    return f"{found['strict TPR']:.3f} / {found['strict FPR']:.4f}"


def main() -> None:
    """Run the samples under each statement and show the rates."""
    options("tolerances", __doc__).parse_args()
    rows = [(what, factor) for what, factors in WRONG for factor in factors]
    cells = {log: in_processes(partial(_of_row, log), rows) for log in LOGS}
    lines = [
        {"stated": what, "factor": factor} | {log: cells[log][n] for log in LOGS}
        for n, (what, factor) in enumerate(rows)
    ]
    show("TPR / FPR strict, by the factor of what is stated", lines)


def _of_row(log: str, row: tuple[str, float]) -> str:
    return rates(log, *row)


if __name__ == "__main__":
    main()
