"""Scoring: the paper's own numbers, and two independent counts of random cases."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.evaluation.rows import equal_pairs
from sonarrec.evaluation.write import Evaluation
from sonarrec.landmarks import load_landmarks
from sonarrec.reports.screen import rate, screen
from tests.support.claims import Scored, all_scored, evaluate
from tests.support.command import sonarrec
from tests.support.rows import read_rows

IDS = (1, 2, 3, 4)
GATE_M = load_landmarks("basin").radius_m
ESTIMATE_HEADER = ("frame", "method", "range_m", "bearing_deg", "landmark", "score", "declared")
TRUTH_HEADER = ("frame", "landmark", "range_m", "bearing_deg", "visible")


def write_csv(path: Path, header, rows) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def write_case(folder: Path, frames, estimates, truth) -> tuple[Path, Path]:
    """frames: numbers. estimates, truth: rows of the headers above. Returns (results, gt.csv)."""
    write_csv(folder / "out" / "frames.csv", ["frame"], [[f] for f in frames])
    write_csv(folder / "out" / "estimates.csv", ESTIMATE_HEADER, estimates)
    write_csv(folder / "gt.csv", TRUTH_HEADER, truth)
    return folder / "out", folder / "gt.csv"


def scored(evaluation: Evaluation, protocol: str, method: str = "m") -> Scored:
    (one,) = [
        s for s in all_scored(evaluation.counts) if (s.protocol, s.method) == (protocol, method)
    ]
    return one


def counts(one: Scored, k: int | None = None, log: int | None = None) -> tuple[int, ...]:
    c = one.count(k, log)
    return c.tp, c.tn, c.fp, c.fn


PAPER_FRAMES = 992
# Per ID: frames in view, those of them claimed, further claims of it there, claimed while absent.
PUBLISHED_COUNTS = {
    "smi": {1: (352, 343, 10, 52), 2: (0, 0, 0, 3), 3: (346, 265, 1, 20), 4: (330, 235, 4, 37)},
    "framework": {
        1: (352, 350, 0, 29),
        2: (0, 0, 0, 0),
        3: (346, 300, 0, 21),
        4: (330, 239, 0, 31),
    },
}
# Tables 4 and 5, columns ID.1 to ID.4 and Total, as printed; "once", 343 / 352 and so on, is ours.
PUBLISHED = {
    "smi": """
        TPR 0.9751 0.0000 0.7666 0.7156 0.8226
        once 0.9744 0.0000 0.7659 0.7121 0.8200
        FPR 0.0813 0.0030 0.0310 0.0559 0.0381
        TP 353 0 266 239 858
        TN 588 989 626 625 2828
        FP 52 3 20 37 112
        FN 9 0 81 95 185
        beta 1002 992 993 996 3983""",
    "framework": """
        TPR 0.9943 0.0000 0.8671 0.7242 0.8648
        once 0.9943 0.0000 0.8671 0.7242 0.8648
        FPR 0.0453 0.0000 0.0325 0.0468 0.0276
        TP 350 0 300 239 889
        TN 611 992 625 631 2859
        FP 29 0 21 31 81
        FN 2 0 46 91 139
        beta 992 992 992 992 3968""",
}


def paper_case(folder: Path) -> tuple[Path, Path]:
    """Frames, estimates and truth that carry the paper's counts."""
    estimates, truth = [], []
    for method, per_id in PUBLISHED_COUNTS.items():
        for landmark, (in_view, claimed, further, absent) in per_id.items():
            first = 97 * landmark  # the IDs come into view at different times, as in the basin
            view = [(first + i) % PAPER_FRAMES for i in range(in_view)]
            rest = [(first + i) % PAPER_FRAMES for i in range(in_view, PAPER_FRAMES)]
            frames = view[:claimed] + view[:further] + rest[:absent]
            estimates += [(f, method, 2.0, 0.0, landmark, 0.9, 1) for f in frames]
            estimates += [(f, method, 2.0, 0.0, landmark, 0.2, 0) for f in view[claimed:]]
            if method == "smi":
                truth += [(f, landmark, 2.0, 0.0, 1.0) for f in view]
    return write_case(folder, range(PAPER_FRAMES), estimates, truth)


@pytest.mark.usefixtures("pictures")
def test_tables_4_and_5_to_the_last_digit(tmp_path: Path) -> None:
    results, truth = paper_case(tmp_path)
    done = sonarrec("evaluate", "--ground-truth", truth, results)
    lines = done.output.splitlines()
    for method, table in PUBLISHED.items():
        start = lines.index(method) + 3
        for line, printed in zip(lines[start:], table.split("\n")[1:], strict=False):
            left = line.split("|")[0].replace("0.0000*", "0.0000").split()
            assert left == printed.split()
    assert "view: ID.2" in done.output
    assert max(len(line) for line in lines if "|" in line) <= 100

    folder = results / "evaluation"
    confusion = [r for r in read_rows(folder / "confusion.csv") if r["protocol"] == "paper"]
    rows = {(r["method"], r["landmark"]): r for r in confusion}
    totals = [rows["smi", i]["total"] for i in ("1", "2", "3", "4", "total")]
    assert totals == ["1002", "992", "993", "996", "3983"]
    assert rows["smi", "2"]["tpr"] == ""  # 0/0 is no result
    assert float(rows["smi", "total"]["tpr_once"]) == pytest.approx(843 / 1028, abs=1e-15)
    assert float(rows["framework", "total"]["tpr"]) == pytest.approx(889 / 1028, abs=1e-15)

    methods = json.loads((folder / "evaluation.json").read_text())["methods"]
    assert methods["smi"]["paper"]["2"]["tpr"] is None
    assert methods["framework"]["paper"]["total"]["fp"] == 81
    figures = {
        (r["landmark"], r["figure"]): (r["value"], r["note"])
        for r in read_rows(folder / "figures.csv")
        if (r["protocol"], r["method"]) == ("paper", "smi")
    }
    for name in ("tpr", "auc"):
        value, note = figures["2", name]
        assert value == ""
        assert "0/0" in note
    assert figures["2", "fpr"][0] == str(3 / 992)
    assert figures["total", "tpr"][0] == str(858 / 1043)
    picture = cv2.imread(str(folder / "roc.png"))
    for bgr in ((0xB2, 0x72, 0x00), (0x00, 0x5E, 0xD5)):  # the colours of both methods
        assert np.count_nonzero((picture == bgr).all(axis=2)) > 100


@pytest.mark.parametrize(
    ("part", "whole", "printed"),
    [(52, 640, "0.0813"), (1, 1, "1.0000"), (0, 7, "0.0000"), (0, 0, "0.0000*")],
)
def test_rates_round_half_up_as_printed(part: int, whole: int, printed: str) -> None:
    assert rate(part, whole) == printed


NEAR, FAR = (2.0, 0.0), (3.0, 0.0)


@pytest.mark.parametrize(
    ("what", "truth", "claims", "paper", "strict"),
    [
        # truth: (place, visible) of ID.1; claims of ID.1; TP, TN, FP, FN of ID.1
        ("right", [(NEAR, 1)], [NEAR], (1, 0, 0, 0), (1, 0, 0, 0)),
        ("missed", [(NEAR, 1)], [], (0, 0, 0, 1), (0, 0, 0, 1)),
        ("absent, not claimed", [], [], (0, 1, 0, 0), (0, 1, 0, 0)),
        ("absent, claimed", [], [NEAR], (0, 0, 1, 0), (0, 0, 1, 0)),
        ("absent, claimed twice", [], [NEAR, FAR], (0, 0, 1, 0), (0, 0, 2, 0)),
        ("wrong place", [(NEAR, 1)], [FAR], (1, 0, 0, 0), (0, 0, 1, 1)),
        ("right and elsewhere", [(NEAR, 1)], [FAR, NEAR], (2, 0, 0, 0), (1, 0, 1, 0)),
        ("one truth claimed twice", [(NEAR, 1)], [NEAR, NEAR], (2, 0, 0, 0), (1, 0, 1, 0)),
        ("half in view", [(NEAR, 0.5)], [], (0, 0, 0, 1), (0, 0, 0, 0)),
        ("half in view, right", [(NEAR, 0.5)], [NEAR, NEAR], (2, 0, 0, 0), (0, 0, 0, 0)),
        ("half in view, elsewhere", [(NEAR, 0.5)], [FAR], (1, 0, 0, 0), (0, 0, 1, 0)),
        ("less than half", [(NEAR, 0.49)], [], (0, 1, 0, 0), (0, 0, 0, 0)),
        ("less than half, right", [(NEAR, 0.49)], [NEAR, NEAR], (0, 0, 1, 0), (0, 0, 0, 0)),
        ("nothing in view", [(NEAR, 0)], [NEAR], (0, 0, 1, 0), (0, 0, 1, 0)),
        ("just enough in view", [(NEAR, 0.9)], [NEAR], (1, 0, 0, 0), (1, 0, 0, 0)),
        ("two of one ID", [(NEAR, 1), (FAR, 1)], [NEAR], (1, 0, 0, 0), (1, 0, 0, 1)),
        ("two, both claimed", [(NEAR, 1), (FAR, 1)], [NEAR, FAR], (2, 0, 0, 0), (2, 0, 0, 0)),
        ("whole and part", [(NEAR, 1), (FAR, 0.5)], [FAR], (1, 0, 0, 0), (0, 0, 0, 1)),
        ("on the gate", [(NEAR, 1)], [(2.15, 0.0)], (1, 0, 0, 0), (1, 0, 0, 0)),
        ("beyond the gate", [(NEAR, 1)], [(2.151, 0.0)], (1, 0, 0, 0), (0, 0, 1, 1)),
    ],
)
def test_rules(tmp_path: Path, what, truth, claims, paper, strict) -> None:
    results, gt = write_case(
        tmp_path,
        [7],
        # Another ID's estimate makes sure that the method is there, and counts for that ID alone.
        [(7, "m", 2.5, 9.0, 2, 0.5, 0)] + [(7, "m", *c, 1, 0.9, 1) for c in claims],
        # A truth without any row is refused.
        [(7, 1, *place, visible) for place, visible in truth] + [(7, 4, 2.5, -9.0, 1)],
    )
    found = evaluate(results, gt)
    assert counts(scored(found, "paper"), 0) == paper, what
    assert counts(scored(found, "strict"), 0) == strict, what
    assert counts(scored(found, "strict"), 1) == (0, 1, 0, 0), what


def test_false_claims_per_100_frames_are_of_the_frames_that_are_scored(tmp_path: Path) -> None:
    """Three in eight frames, two of them in one; the landmark lies in the first two frames."""
    right = [(f, "m", *NEAR, 1, 0.9, 1) for f in (0, 1)]
    wrong = [(0, "m", *FAR, 1, 0.9, 1), (0, "m", *FAR, 2, 0.9, 1), (6, "m", *FAR, 2, 0.9, 1)]
    case = write_case(tmp_path, range(8), right + wrong, [(f, 1, *NEAR, 1) for f in (0, 1)])
    found = evaluate(*case)
    assert scored(found, "strict").count().false_per_100 == 100 * 3 / 8
    assert [scored(found, "strict").count(k).false_per_100 for k in (0, 1, 2)] == [12.5, 25, 0]
    assert scored(found, "paper").count().false_per_100 == 25  # ID.1 is in view where it is claimed
    of_labelled = evaluate(*case, labelled_only=True)
    assert scored(of_labelled, "strict").count().false_per_100 == 100 * 2 / 2
    assert found.table.loc["m", "strict false per 100"] == 37.5
    shown = screen(found).splitlines()
    assert [line.split()[-1] for line in shown if "per 100 frames" in line] == ["37.50"]


def test_min_visible_is_of_protocol_strict_alone(tmp_path: Path) -> None:
    truth = [(f, 1, *NEAR, visible) for f, visible in enumerate([1.0, 0.7, 0.5, 0.3])]
    case = write_case(tmp_path, range(4), [(3, "m", *NEAR, 1, 0.9, 1)], truth)
    for least, strict in ((0.9, (0, 0, 0, 1)), (0.6, (0, 0, 0, 2)), (0.2, (1, 0, 0, 3))):
        found = evaluate(*case, min_visible=least)
        assert counts(scored(found, "paper"), 0) == (0, 0, 1, 3)
        assert counts(scored(found, "strict"), 0) == strict


def test_dropping_frames_from_the_estimates_does_not_raise_tpr(tmp_path: Path) -> None:
    frames = range(20)
    truth = [(f, 1, 2.0, 0.0, 1.0) for f in frames]
    estimates = [(f, "m", 2.0, 0.0, 1, 0.9, 1) for f in frames if f % 2]
    full = scored(evaluate(*write_case(tmp_path / "a", frames, estimates, truth)), "strict")
    assert counts(full, 0) == (10, 0, 0, 10)
    # Frames that were never processed leave with their truth, and their estimates do not count.
    cut = evaluate(*write_case(tmp_path / "b", frames[:10], estimates, truth))
    assert counts(scored(cut, "strict"), 0) == (5, 0, 0, 5)
    estimates_left, rows_left = cut.unused
    assert "5 estimates" in estimates_left
    assert "10 of 20 rows" in rows_left


def random_case(rng: np.random.Generator) -> tuple[list, list, list]:
    """Frames, estimates and truth with duplicates, wrong places, part views and tied scores."""
    frames = sorted(rng.choice(12, size=rng.integers(1, 9), replace=False).tolist())

    def place() -> tuple[float, float]:
        return float(rng.uniform(1.9, 2.2)), float(rng.uniform(-4, 4))

    truth, estimates = [], []
    for frame in frames:
        for landmark in IDS:
            for _ in range(rng.choice([0, 1, 2], p=[0.5, 0.4, 0.1])):
                truth.append((frame, landmark, *place(), rng.choice([1.0, 0.9, 0.6, 0.4, 0.0])))
        for _ in range(rng.integers(0, 6)):
            score = round(float(rng.random()), 1)
            landmark = int(rng.choice(IDS))
            estimates.append((frame, "m", *place(), landmark, score, int(rng.random() < 0.6)))
    estimates.append((frames[0], "m", *place(), 1, 0.5, 1))
    truth.append((frames[0], 4, *place(), 1.0))
    return frames, estimates, truth


def count_frame_by_frame(frames, claims, truth, protocol: str, landmark: int) -> list[int]:
    """[TP, TN, FP, FN] of one ID: the rules of the contract, said once more without arrays."""
    tp = tn = fp = fn = 0

    def away(a, b) -> float:
        """By the law of cosines, from (range, bearing)."""
        turn = math.cos(math.radians(a[1] - b[1]))
        return math.sqrt(a[0] ** 2 + b[0] ** 2 - 2 * a[0] * b[0] * turn)

    for frame in frames:
        here = [t for t in truth if t[0] == frame and t[1] == landmark and t[4] > 0]
        made = [c for c in claims if c[0] == frame and c[4] == landmark]
        whole = [t for t in here if t[4] >= 0.9]
        if protocol == "paper":
            if any(t[4] >= 0.5 for t in here):
                tp += len(made)
                fn += not made
            else:
                fp += bool(made)
                tn += not made
            continue
        taken: set = set()
        for c in made:
            near = min(here, key=lambda t: away(c[2:4], t[2:4]), default=None)
            if near is None or away(c[2:4], near[2:4]) > GATE_M:
                fp += 1
            elif near in whole:
                fp += near in taken
                taken.add(near)
        tp += len(taken)
        fn += len(whole) - len(taken)
        tn += not here and not made
    return [tp, tn, fp, fn]


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_counts_and_curves_equal_a_count_frame_by_frame(tmp_path_factory, seed: int) -> None:
    frames, estimates, truth = random_case(np.random.default_rng(seed))
    found = evaluate(*write_case(tmp_path_factory.mktemp("case"), frames, estimates, truth))
    for protocol in ("paper", "strict"):
        one = scored(found, protocol)

        def brute(claims, protocol=protocol) -> np.ndarray:
            return np.array([count_frame_by_frame(frames, claims, truth, protocol, i) for i in IDS])

        expected = brute([c for c in estimates if c[6]])
        assert [list(counts(one, k)) for k in range(4)] == expected.tolist()
        assert list(counts(one)) == expected.sum(axis=0).tolist()
        for k in (0, 1, 2, 3, None):
            curve = one.curve(k)
            assert curve["threshold"][0] == math.inf
            assert (np.diff(curve["threshold"]) < 0).all()  # ties are one point
            for j, threshold in enumerate(curve["threshold"]):
                at = brute([c for c in estimates if c[5] >= threshold])
                at = at.sum(axis=0) if k is None else at[k]
                point = [curve["tp"][j], curve["tn"][j], curve["fp"][j], curve["fn"][j]]
                assert point == at.tolist()
            # Rates never fall as the threshold does.
            assert not (np.diff(curve["tpr"]) < 0).any()
            assert not (np.diff(curve["fpr"]) < 0).any()


RUN_TOML = """
[sonar]
layout = "fan"
range_min_m = 1.25
range_max_m = 3.75
field_of_view_deg = 28.8
tilt_deg = 20.0
metres_per_pixel = 0.01
apex_px = [100.0, 400.0]
"""


def test_run_toml_landmarks_set_ids_and_gate(tmp_path: Path) -> None:
    results, truth = write_case(
        tmp_path, [0], [(0, "m", 2.0, 0.0, 8, 0.9, 1)], [(0, 8, 2.25, 0.0, 1.0)]
    )
    with pytest.raises(Exception, match="landmark 8"):
        evaluate(results, truth)
    (results / "run.toml").write_text(
        '[landmarks]\nname = "big"\nradius_m = 0.3\nring = [0.8, 1.0]\nsymbol = [0.0, 0.6]\n'
        "[[landmarks.landmark]]\nid = 9\nsectors = [1, 0, 0]\n"
        "[[landmarks.landmark]]\nid = 8\nsectors = [1, 1, 0]\n"
    )
    found = evaluate(results, truth)
    assert found.counts.ids == (9, 8)
    assert counts(scored(found, "strict"), 1) == (1, 0, 0, 0)
    assert counts(scored(found, "strict"), 0) == (0, 1, 0, 0)


NUMBERS = st.lists(st.integers(-5, 5), max_size=8)


@given(a=NUMBERS, b=NUMBERS, within=st.integers(0, 3))
def test_pairs_are_those_of_every_a_with_every_b(a: list[int], b: list[int], within: int) -> None:
    pairs = zip(*equal_pairs(np.array(a, int), np.array(b, int), within), strict=True)
    expected = [(i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= within]
    assert sorted(pairs) == expected
