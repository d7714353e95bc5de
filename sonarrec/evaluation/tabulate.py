"""Evaluation told: the paper's table layout on screen, and the files of `evaluation/`."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

from sonarrec.evaluation.curves import Count
from sonarrec.evaluation.scoring import Evaluation, Scored
from sonarrec.records import SonarrecError

CONFUSION = ("protocol", "method", "landmark", "tpr", "fpr", "tp", "tn", "fp", "fn", "total")
ROC = ("protocol", "method", "landmark", "threshold", "tpr", "fpr", "tp", "tn", "fp", "fn")
WIDTH = 100


def rate(part: int, whole: int) -> str:
    """A rate to four digits, halves upward as in the paper; "0.0000*" for 0/0."""
    if whole == 0:
        return "0.0000*"
    # In whole numbers: 52/640 is .08125 and printed .0813, which binary rounding makes .0812.
    digits = (2 * 10_000 * part + whole) // (2 * whole)
    return f"{digits // 10_000}.{digits % 10_000:04d} "


def paper_table(scored: Scored) -> list[str]:
    """The lines of one of the paper's tables: a heading, then TPR to Total, per ID and in all."""
    counts = [scored.count(k) for k in range(len(scored.ids))] + [scored.count()]
    rows: list[tuple[str, list[str]]] = [
        ("", [f"ID.{i} " for i in scored.ids] + ["Total "]),
        ("TPR", [rate(c.tp, c.tp + c.fn) for c in counts]),
        ("FPR", [rate(c.fp, c.fp + c.tn) for c in counts]),
    ]
    rows += [
        (label, [f"{getattr(c, label.lower())} " for c in counts])
        for label in ("TP", "TN", "FP", "FN", "Total")
    ]
    return [f"{label:<5}" + "".join(f"{cell:>8}" for cell in cells) for label, cells in rows]


def screen(evaluation: Evaluation) -> str:
    """All tables: per method, the protocols side by side where they fit 100 columns."""
    lines: list[str] = []
    undefined = False
    for method in evaluation.joined.methods:
        tables = [s for s in evaluation.scored if s.method == method]
        blocks = []
        for scored in tables:
            block = paper_table(scored)
            width = max(map(len, block))
            blocks.append([line.ljust(width) for line in [_title(scored, evaluation), *block]])
            undefined |= any("*" in line for line in block)
        lines += [method]
        if sum(len(b[1]) for b in blocks) + 3 * (len(blocks) - 1) <= WIDTH:
            lines += [" | ".join(row).rstrip() for row in zip(*blocks, strict=True)]
        else:
            lines += [line.rstrip() for block in blocks for line in [*block, ""]][:-1]
        lines.append("")
    if undefined:
        lines += ["* 0/0, printed as the paper prints it: nothing to measure here", ""]
    return "\n".join(lines)


def _title(scored: Scored, evaluation: Evaluation) -> str:
    if scored.protocol == "paper":
        return "protocol paper: position not checked"
    gates = sorted({float(gate) for gate in evaluation.joined.gate})
    return "protocol strict" + (
        f": centre within {' or '.join(f'{g:g}' for g in gates)} m" if gates else ""
    )


def _cells(scored: Scored) -> list[tuple[str, Count]]:
    named = [(str(i), scored.count(k)) for k, i in enumerate(scored.ids)]
    return [*named, ("total", scored.count())]


def _blank(value: float) -> float | str:
    return "" if math.isnan(value) else value


def write_confusion(path: Path, evaluation: Evaluation) -> None:
    """confusion.csv as in the contract; a rate that is 0/0 is an empty cell."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CONFUSION)
        for s in evaluation.scored:
            for name, c in _cells(s):
                rates = (_blank(c.tpr), _blank(c.fpr))
                writer.writerow(
                    (s.protocol, s.method, name, *rates, c.tp, c.tn, c.fp, c.fn, c.total)
                )


def write_roc(path: Path, evaluation: Evaluation) -> None:
    """roc.csv: the corners of every curve, thresholds falling from inf."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(ROC)
        for s in evaluation.scored:
            for name, k in [*((str(i), k) for k, i in enumerate(s.ids)), ("total", None)]:
                curve = s.curve(k)
                at = curve.turns()
                columns = [curve.threshold, curve.tpr, curve.fpr, curve.tp, curve.tn]
                columns += [curve.fp, curve.fn]
                for row in zip(*(column[at].tolist() for column in columns), strict=True):
                    tpr, fpr = _blank(row[1]), _blank(row[2])
                    writer.writerow((s.protocol, s.method, name, row[0], tpr, fpr, *row[3:]))


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """evaluation.json: what was scored, how, and every count; a rate that is 0/0 is null."""
    joined = evaluation.joined
    methods: dict[str, Any] = {}
    for s in evaluation.scored:
        methods.setdefault(s.method, {})[s.protocol] = {
            name: {
                "tpr": None if math.isnan(c.tpr) else c.tpr,
                "fpr": None if math.isnan(c.fpr) else c.fpr,
                **{"tp": c.tp, "tn": c.tn, "fp": c.fp, "fn": c.fn, "total": c.total},
            }
            for name, c in _cells(s)
        }
    return {
        "logs": list(joined.logs),
        "frames": len(joined.frame),
        "landmarks": list(joined.ids),
        "positives": int(joined.truth_positive.sum()),
        "ignored": int((~joined.truth_positive).sum()),
        "min_visible": evaluation.min_visible,
        "gate_m": sorted({float(gate) for gate in joined.gate}),
        "methods": methods,
        "notes": list(evaluation.notes),
        "unused": list(evaluation.unused),
    }


def write_evaluation(folder: Path, evaluation: Evaluation) -> None:
    """Write confusion.csv, roc.csv, roc.png and evaluation.json into `folder`, made if need be.

    evaluation.json goes last, so where it stands the others are whole.
    Raises SonarrecError where they cannot be written.
    """
    from sonarrec.evaluation.plots import draw_roc

    text = json.dumps(as_json(evaluation), indent=2, allow_nan=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "evaluation.json").unlink(missing_ok=True)
        write_confusion(folder / "confusion.csv", evaluation)
        write_roc(folder / "roc.csv", evaluation)
        draw_roc(folder / "roc.png", evaluation.scored)
        (folder / "evaluation.json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise SonarrecError(f"{folder}: cannot be written ({error})") from None
