"""The part of README.md that `make results` fills, from what the studies recorded."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from sonarrec.evaluation.plots import PUBLISHED
from tests.studies.results.record import ROOT, read, stale

README = ROOT / "README.md"
POOLED = "the twelve kinds together"
BEGIN, END = "<!-- filled by make results -->\n", "<!-- end -->\n"
KINDS = {
    "plain": "nothing that disturbs",
    "low_contrast": "faint landmarks",
    "window_1_25": "a range window of 1.25 m",
    "window_5": "a range window of 5 m",
    "jitter": "an unsteady sonar",
    "ring_widths": "rings of other widths",
    "fading": "echoes that fade",
    "occluded": "landmarks that are partly covered",
    "near_miss": "fakes that resemble landmarks",
    "fast_pan": "a fast pan",
    "small_discs": "discs of .09 to .12 m radius",
    "no_landmark": "no landmark",
    "tiny_discs": "discs of .06 m radius",
    "all_hard": "several difficulties together",
    "other_sets": "other landmark sets",
    "any_floor": "plates of any level, from 12 dB below the floor to 6 dB above it",
    "relief": "gravel on a rough floor",
    "light": "patches of light and shade",
    "debris": "twigs and weed on a blotchy floor",
    "symbols": "rings with symbols that no ID has",
    "wide": "a view of 120 to 130 deg with beams of 1 deg",
    "other_symbols": "rings with symbols of kinds that nothing was learned from",
    "slope": "a floor that slopes by up to 8 deg",
    "leaning": "discs tilted by up to 15 deg",
    "silted": "discs of which a tenth to two fifths is under silt",
    "ripples": "ripples in the sand",
    "multipath": "a second copy of the scene by way of the surface",
    "fish": "fish",
    "vehicle": "a vehicle that travels and turns",
    "glitter": "single bright stones on rings and symbols",
}
"""What is in the scenes of a kind."""


METHODS = ("smi", "default", "offline")


def filled(text: str, now: Mapping[str, str]) -> str:
    """README.md with the lines from BEGIN to END made from the records. now: as of `page`."""
    before, _, rest = text.partition(BEGIN)
    lines = "".join(f"{line}\n" for line in _lines(now))
    return "".join([before, BEGIN, lines, END, rest.partition(END)[2]])


def _lines(now: Mapping[str, str]) -> Iterator[str]:
    marks = {}
    for name in ("scenes_fresh", "worlds", "paper", "bench"):
        marks[name] = "† " if stale(read(name), now) else ""
    rates = [f"`{name}` {rate}" for name in METHODS for rate in ("TPR", "FPR")]
    head = ["recordings", *rates, "[all results](tests/studies/RESULTS.md)"]
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    scenes, false = _scenes()
    for name, rows in (("scenes_fresh", scenes), ("worlds", _others()), ("paper", _paper())):
        link = read(name)["title"].lower().replace(" ", "-")
        link = f"[more](tests/studies/RESULTS.md#{re.sub('[^a-z-]', '', link)})"
        yield from (f"| {marks[name]}{' | '.join([*cells, link])} |" for cells in rows)
    yield from ("", f"{false} {_about_rows()}")
    note = (
        " † measured with an earlier state of the program; not yet repeated with this one."
        if any(marks.values())
        else ""
    )
    yield from ("", f"{marks['bench']}{_cost()}{note}")


def _scenes() -> tuple[list[list[str]], str]:
    """All kinds pooled, the kind with the lowest TPR, and the one with the highest FPR; and a
    sentence on their false claims."""
    rows = {row["kind of scene"]: row for row in _rows("scenes_fresh") if "kind of scene" in row}
    kinds = {found[1]: row for label, row in rows.items() if (found := re.search("`(.+)`", label))}
    rates = {kind: _rates(row["`default`"]) for kind, row in kinds.items()}
    lowest = min((k for k in rates if not math.isnan(rates[k][0])), key=lambda k: rates[k][0])
    highest = max(rates, key=lambda k: rates[k][1])
    shown = {"random scenes of twelve kinds": rows[POOLED]}
    shown |= {KINDS[kind]: kinds[kind] for kind in (lowest, highest)}
    cells = [[of, *_cells(row[f"`{name}`"] for name in METHODS)] for of, row in shown.items()]
    default, offline = (
        "{}, {} and {}".format(*(row[f"`{name}`, false"].split()[0] for row in shown.values()))
        for name in METHODS[1:]
    )
    false = f"`default` makes {default} false claims in 100 frames, `offline` {offline}"
    return cells, f"In rows 1, 2 and 3 {false}."


def _cells(both: Iterable[str]) -> Iterator[str]:
    """TPR and FPR of each method, a cell for each, with its interval. both: of each method."""
    for cell in both:
        yield from cell.split(" / ")


def _others() -> list[list[str]]:
    """The clip of a real tag, ranges over recordings that the simulator did not make, and claims in
    real ones without a landmark."""
    ranges, named, claims = list[str](), list[str](), list[str]()
    made = _made_by_others()
    real = [row for row in _rows("worlds") if "radius" in row]
    (clip,) = (row for row in _rows("worlds") if "frames with the tag" in row)
    frames = sum({row["recording"]: int(row["frames"]) for row in real}.values())
    for name in METHODS[1:]:
        tprs, fprs = zip(*(_rates(row[name]) for row in made), strict=True)
        ranges += [_range(tprs, 3), _range(fprs, 4)]
        named += [f"{clip[f'{name}: named']} of {clip['frames with the tag']} frames"]
        named += [f"{clip[f'{name}: wrong ID']} wrong IDs"]
        false = sum(int(row[f"{name}: frames with a claim"]) for row in real)
        claims += ["", f"{false} of {frames} frames"]
    return [
        ["a real clip of an AcTag", "", "", *named],
        ["not made by our simulator", "", "", *ranges],
        ["real rivers without a landmark", "", "", *claims],
    ]


def _made_by_others() -> list[dict[str, str]]:
    return [row for row in _rows("worlds") if "default" in row]


def _about_rows() -> str:
    """What the rows are, where their names do not say it."""
    return (
        "Row 1 pools the random scenes; rows 2 and 3 are the kinds of them with the lowest TPR and "
        "with the highest FPR. No setting was chosen on any of them. "
        f"Not made by our simulator are {len(_made_by_others())} kinds: recordings of Stonefish, "
        "of another basin simulator, ray-traced ones, and rings drawn into recordings of real "
        "rivers. Their cells have the lowest and the highest rate."
    )


def _paper() -> list[list[str]]:
    of = {row["method"]: row["paper"] for row in _rows("paper") if {"method", "paper"} <= set(row)}
    published = _cells(f"{tpr:.4f} / {fpr:.4f}" for _, fpr, tpr in PUBLISHED)
    return [
        ["protocol `paper`, `--preset paper`", *_cells((of["SMI"], of["framework"])), "", ""],
        ["the same as published", *published, "", ""],
    ]


def _cost() -> str:
    """A frame's time, of sonarrec and of both peers, as a range over the scenes that all ran on."""
    rows = [*_rows("bench")]
    peak = {row["what"]: float(row["measured"]) for row in rows if "peak" in row.get("what", "")}
    timed = [row for row in rows if row.get("TPR / FPR")]
    said = {}
    for name in {row["per frame"] for row in timed}:
        own = [row for row in timed if row["per frame"] == name]
        tprs = _range([_rates(row["TPR / FPR"])[0] for row in own], 2)
        said[name] = f"{_range([float(row['ms']) for row in own], 1)} ms (TPR {tprs})"
    return (
        f"In {len(own)} scenes a frame of 512 rows takes {said['sonarrec']} of CPU on a slow "
        "machine. Two simple detectors with OpenCV's Hough circles, for comparison, take "
        f"{said['hough_majority']} and {said['hough_half']}. "
        f"Peak memory is {peak['peak memory, 3000 frames, MB']:.0f} MB, "
        f"for views of 130 deg {peak['peak memory, 144 PNGs, 130 deg, MB']:.0f} MB (`make bench`)."
    )


def _rows(name: str) -> Iterator[dict[str, str]]:
    for table in read(name)["table"]:
        yield from csv.DictReader(table["csv"].strip().splitlines())


def _rates(cell: str) -> list[float]:
    """TPR and FPR of `0.98 (0.97-0.99) / 0.0002 (0.0000-0.0003)`; NaN for a dash."""
    numbers = (part.split()[0] for part in cell.split(" / "))
    return [math.nan if number == "-" else float(number) for number in numbers]


def _range(values: Sequence[float], digits: int) -> str:
    low, high = (f"{edge:.{digits}f}" for edge in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
