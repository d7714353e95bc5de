"""Whether results are good enough: against those before, and against absolute limits.

`compare` joins the counts of two sets of results; `judge` says in one sentence and one table what
that means. `evaluate --compare`, `check` and limits rest on both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sonarrec.errors import Diagnostics, SonarrecError, UsageError, number_of, printable
from sonarrec.evaluation.counts import TOTAL, Counts
from sonarrec.evaluation.evaluate import Advise, LogToScore, lacks, score_logs
from sonarrec.evaluation.figures import MAIN, METRICS, differences, few_units, rates, units_text
from sonarrec.evaluation.pairs import Pair, find_truths, pair_up
from sonarrec.evaluation.rows import ScoringOptions
from sonarrec.evaluation.uncertainty import draws
from sonarrec.evaluation.write import write_table
from sonarrec.results.columns import chosen
from sonarrec.results.folders import log_of
from sonarrec.results.run_file import read_run
from sonarrec.sonar.frame import follows
from sonarrec.tables.outputs import check_folder, check_tables, writing

FRAMES_FREE = 2
"""So many frames may get worse, whatever the band: 2 of 24 are no trend, though they are .083."""
RATES = ["tpr", "fpr"]
"""Those that a judgement rests on."""
SAME = 5e-5
"""Without a band: a smaller change of a rate does not show in its digits."""
SIGNIFICANT = 0.05
"""With a p above this a difference is said to be possibly due to chance."""
EACH = ""
"""Stands for every method that is judged, in the limits."""
MOST_NAMED = 3
"""Logs that a sentence names."""
COMPARE = [
    *("protocol", "method", "landmark", "rate", "old", "new", "worse_by", "of"),
    *("log", "low", "high", "p", "units", "note"),
]
"""Columns of compare.csv. low, high and p are of the difference; of: the cases of the rate."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What results must keep."""

    band: float | None = None
    """By how much a rate may be worse than before, if by more than two frames; None: not asked."""
    least_tpr: Mapping[str, float] = field(default_factory=dict)
    most_fpr: Mapping[str, float] = field(default_factory=dict)
    """By method, or EACH. They hold for the rates over all IDs and logs under protocol strict,
    under protocol paper where strict cannot be scored."""
    methods: tuple[str, ...] = ()
    """Those looked at; empty: all that follow objects, or all if none does."""

    @property
    def are_given(self) -> bool:
        """Whether anything is to be kept."""
        return self.band is not None or bool(self.least_tpr or self.most_fpr)

    def methods_to_judge(self, methods: Iterable[str]) -> tuple[str, ...]:
        """The methods to judge, of those in the results. Raises UsageError for one not there."""
        known = tuple(dict.fromkeys(methods))
        if unknown := sorted({*self.methods, *self.least_tpr, *self.most_fpr} - {EACH, *known}):
            has = ", ".join(known)
            raise UsageError(f"method {unknown[0]}: the results have no such method, but {has}")
        return self.methods or tuple(filter(follows, known)) or known

    def broken(self, counts: Counts, methods: Sequence[str] = ()) -> list[str]:
        """A line for each absolute limit that the results do not keep.

        methods: to judge; empty: those of `methods_to_judge`, which raises UsageError.
        """
        methods = methods or self.methods_to_judge(counts.methods)
        protocol, lines = counts.protocols[-1], []  # strict, if it is scored
        for method in counts.methods:
            for name, limits in (("tpr", self.least_tpr), ("fpr", self.most_fpr)):
                limit = limits.get(method, limits.get(EACH) if method in methods else None)
                rate = getattr(counts.count(method, protocol), name)
                # A TPR of 0/0 shows nothing, so it keeps no limit.
                if limit is None or (rate >= limit if name == "tpr" else not rate > limit):
                    continue
                beyond = f"{'below' if name == 'tpr' else 'above'} {limit:g}"
                figure = f"{METRICS[name].label} {rate_text(rate)} ({method}, {protocol})"
                lines.append(f"limit not kept: {figure} is {beyond}")
        return lines


@dataclass(frozen=True, slots=True, repr=False)
class Comparison:
    """What `compare` found."""

    before: Counts
    after: Counts
    """Of the same logs, frames and passes."""
    methods: tuple[tuple[str, str], ...]
    """(protocol, method) of those in both results, the leading method first."""
    rates: pd.DataFrame
    """COMPARE: per ID and in total; of several logs also of each."""
    lost: tuple[str, ...]
    """Methods that only the old results have."""
    gained: tuple[str, ...]
    """Methods that only the new results have."""
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    """Input that could not be used, one line each."""
    left_out: int | None = None
    """Frames that are not labelled, if only labelled ones count; else None."""

    @property
    def logs(self) -> tuple[str, ...]:
        return self.after.logs

    @property
    def verdict(self) -> str:
        """Whether the new results are better or worse, in one sentence."""
        return judge(self, Limits()).sentence

    @property
    def figures(self) -> pd.DataFrame:
        """The rates as in compare.csv: those known in the old or the new results."""
        known = self.rates.old.notna() | self.rates.new.notna()
        return self.rates[known].reset_index(drop=True)

    def __repr__(self) -> str:
        return f"<{self.verdict}>"


def compare(
    old: Path,
    new: Path,
    ground_truth: Path | Sequence[Pair] | None,
    options: ScoringOptions,
    advise: Advise | None = None,
) -> Comparison:
    """Compare old and new results on common frames; see `sonarrec.compare`.

    advise: its lines are among `notes` and `unused`.
    """
    options.check()
    diagnostics = Diagnostics()
    logs = _logs(pair_up(old, new, diagnostics), ground_truth, diagnostics)
    is_one = isinstance(ground_truth, Path) and not ground_truth.is_dir()
    one_truth_of = new if is_one else None
    return _compared((old, new), logs, options, diagnostics, advise, one_truth_of)


def compare_sets(
    old: Path,
    new: Path,
    pairs: Sequence[Pair],
    options: ScoringOptions,
    advise: Advise | None = None,
) -> dict[str, Comparison]:
    """As `compare`, with the logs of each landmark set by themselves; by the name of the set.

    Raises SonarrecError as `compare`, if those of any set cannot be compared.
    """
    options.check()
    diagnostics = Diagnostics()
    logs_of: dict[frozenset[int], list[LogToScore]] = {}
    name_of: dict[frozenset[int], str] = {}
    for log in _logs(pair_up(old, new, diagnostics), pairs, diagnostics):
        landmarks = read_run(log.results[-1] / "run.toml").landmark_set(options.landmarks)
        ids = frozenset(landmarks.ids)
        logs_of.setdefault(ids, []).append(log)
        used = landmarks.name in name_of.values()
        name_of.setdefault(ids, f"{landmarks.name}-{len(logs_of)}" if used else landmarks.name)
    compared = {}
    for ids, logs in logs_of.items():
        compared[name_of[ids]] = _compared((old, new), logs, options, diagnostics, advise)
        diagnostics = Diagnostics()  # what is about all logs is in those of the first
    return compared


def _compared(
    sides: tuple[Path, Path],
    logs: Sequence[LogToScore],
    options: ScoringOptions,
    diagnostics: Diagnostics,
    advise: Advise | None,
    one_truth_of: Path | None = None,
) -> Comparison:
    """The comparison of logs, old and new. sides: their folders, for messages."""
    old, new = sides
    scored, (before, after), _ = score_logs(
        logs, options, "compared", diagnostics, one_truth_of, advise
    )
    both = [m for m in after.methods if m in before.methods]
    methods = chosen({*before.methods, *after.methods}, options.methods, ", ".join(after.logs))
    for side, counts in ((old, before), (new, after)):
        diagnostics.note(*(f"{side}: {line}" for line in lacks(counts)))
    if before.placed != after.placed:
        without = new if before.placed else old
        diagnostics.note(
            f"protocol strict is not compared: {without} has no positions that can be used"
        )
    compared = tuple(
        (protocol, method)
        for method in methods
        for protocol in after.protocols
        if method in both and protocol in before.protocols
    )
    if not compared:
        has = (f"{side} has {', '.join(p.methods)}" for side, p in ((old, before), (new, after)))
        raise SonarrecError(
            printable(f"nothing to compare: no method is in both; {'; '.join(has)}")
        )
    return Comparison(
        before=before,
        after=after,
        methods=compared,
        rates=_rates(before, after, compared),
        lost=tuple(m for m in methods if m not in after.methods),
        gained=tuple(m for m in methods if m not in before.methods),
        notes=(*diagnostics.notes, *few_units(after)),
        unused=tuple(diagnostics.problems),
        left_out=sum(score.left_out for score in scored) if options.labelled_only else None,
    )


def _logs(
    folders: Sequence[tuple[Path, Path]],
    ground_truth: Path | Sequence[Pair] | None,
    diagnostics: Diagnostics,
) -> list[LogToScore]:
    """The logs of these old and new folders that have a truth, by name; others are problems."""
    pairs: Sequence[Pair]
    if ground_truth is None or isinstance(ground_truth, Path):
        pairs = find_truths([now for _, now in folders], diagnostics, ground_truth)
    else:
        pairs = ground_truth
    of_name: dict[str | None, Pair] = {}
    for pair in pairs:
        of_name.setdefault(pair.log, pair)
        of_name.setdefault(pair.results.absolute().name, pair)
    logs = []
    for both in folders:
        names = [f.absolute().name for f in reversed(both)]
        matches = [of_name[name] for name in names if name in of_name]
        if matches:
            name = matches[0].log or log_of(both[1])
            logs.append(LogToScore(both, matches[0].ground_truth, name))
        elif pairs is ground_truth:
            diagnostics.problem(f"{both[1]}: the pairs name no truth for it; not compared")
    if not logs:
        raise SonarrecError(diagnostics.problems[-1])
    return logs


def _rates(before: Counts, after: Counts, compared: Sequence[tuple[str, str]]) -> pd.DataFrame:
    """The rates of MAIN per ID and in total, with tests; then of each of several logs."""
    weights, tosses = draws(after.units.number)
    rows: list[dict[str, Any]] = []
    for protocol, method in compared:
        # One ID at a time, since the curves of many logs are long.
        sides = zip(*(rates(side, method, protocol) for side in (before, after)), strict=True)
        tests = [d for a, b in sides for d in differences(a, b, weights, tosses)]
        in_all = {"method": method, "log": ""}
        rows += [d._asdict() | in_all for d in tests if d.figure in MAIN]
        for log in after.logs if len(after.logs) > 1 else ():
            old, new = (side.count(method, protocol, log=log) for side in (before, after))
            in_log = {"protocol": protocol, "method": method, "landmark": TOTAL, "log": log}
            for name in RATES:
                values = {"value_a": getattr(old, name), "value_b": getattr(new, name)}
                rows.append(in_log | {"figure": name, **values, "units": 0, "note": ""})
    for row in rows:
        count = after.count(row["method"], row["protocol"], row["landmark"], row["log"])
        # An area is over as many cases as the TPR.
        row["of"] = count.fp + count.tn if row["figure"] == "fpr" else count.tp + count.fn
    table = pd.DataFrame(rows).rename(
        columns={"figure": "rate", "value_a": "old", "value_b": "new"}
    )
    up = table.new.fillna(0) - table.old.fillna(0)  # 0/0 counts as 0
    return table.assign(worse_by=up.where(table.rate == "fpr", -up))[COMPARE]


class Row(NamedTuple):
    """The rates of one method under one protocol: of a log, or of all (TOTAL)."""

    log: str
    method: str
    protocol: str
    tpr: Any
    fpr: Any
    """Rows of Comparison.rates, with sign: 1 if worse by more than the band, -1 if better, or 0."""
    mark: str
    """"worse", "better", or "" if no rate changed by more than the band. With a band "worse" if
    either rate is; without, the rate that changed more decides."""

    @property
    def text(self) -> str:
        """Such as "TPR 0.9861 -> 0.6903 (framework, strict)": what changed, or both rates."""
        texts = [f"{METRICS[rate.rate].label} {change_text(rate)}" for rate in self[3:5]]
        changed = [text for text in texts if "->" in text]
        return f"{', '.join(changed or texts)} ({self.method}, {self.protocol})"

    @property
    def larger(self) -> Any:
        """The rate that changed more."""
        return max(self.tpr, self.fpr, key=lambda rate: abs(rate.worse_by))


def rate_text(rate: float) -> str:
    """A rate to four digits, or "0/0"."""
    return "0/0" if math.isnan(rate) else f"{rate:.4f}"


def change_text(rate: Any) -> str:
    """A rate before and now; once if its digits are the same."""
    old, new = rate_text(rate.old), rate_text(rate.new)
    return old if old == new else f"{old} -> {new}"


@dataclass(frozen=True, slots=True)
class Judgement:
    """What `judge` found."""

    sentence: str
    """Begins with worse, limit not kept, better, as good, or unchanged."""
    rows: tuple[Row, ...]
    """Of every log, then of all if there are several."""
    faults: tuple[str, ...]
    """A line for each rate that is worse, and for each limit that is not kept."""


def judge(compared: Comparison, limits: Limits) -> Judgement:
    """Judge new results by the old ones and by the limits.

    Worse, with a band, is a rate over all IDs in one log, or of one ID or of all IDs in all logs.
    Raises UsageError if a method that the limits name is in neither.
    """
    named = (*(method for _, method in compared.methods), *compared.gained, *compared.lost)
    methods, band = limits.methods_to_judge(named), limits.band
    rates = compared.rates
    least = SAME if band is None else np.maximum(band, FRAMES_FREE / rates.of.clip(1)) + 1e-9
    sign = np.sign(rates.worse_by) * (rates.worse_by.abs() >= least)
    judged = rates.assign(sign=sign)[rates.method.isin(methods)]
    faults = [f"worse: {m}: no longer in the results" for m in compared.lost if m in methods]
    if compared.before.placed and not compared.after.placed:
        faults.append("worse: protocol strict: no longer scored")
    for r in judged[judged.sign > 0].itertuples() if band is not None else ():
        log = f"{r.log}: " if r.log else ""
        label = "" if r.log else f", {'ID.' if r.landmark.isdigit() else ''}{r.landmark}"
        rate = f"{METRICS[r.rate].label} was {rate_text(r.old)}, is {rate_text(r.new)}"
        faults.append(f"worse: {log}{r.method}, {r.protocol}{label}: {rate}")
    broken = limits.broken(compared.after, methods)
    rows = _rows(compared, judged, either=band is not None)
    sentence = _sentence(compared, rows, faults, broken, band)
    return Judgement(sentence, rows, (*faults, *broken))


def _rows(compared: Comparison, judged: pd.DataFrame, *, either: bool) -> tuple[Row, ...]:
    """A row per log, protocol and method, the stricter protocol first. either: see Row.mark."""
    several, rows = len(compared.logs) > 1, []
    total = judged[(judged.landmark == TOTAL) & judged.rate.isin(RATES)]
    rank = {log: n for n, log in enumerate([*compared.logs, ""])}
    total = total.sort_values("protocol", ascending=False, kind="stable")
    total = total.sort_values("log", key=lambda names: names.map(rank), kind="stable")
    for (log, protocol, method), two in total.groupby(["log", "protocol", "method"], sort=False):
        tpr, fpr = two.itertuples(index=False)
        row = Row(log or (TOTAL if several else compared.logs[0]), method, protocol, tpr, fpr, "")
        signs = {rate.sign for rate in ((tpr, fpr) if either else (row.larger,))}
        rows.append(row._replace(mark="worse" if 1 in signs else "better" if -1 in signs else ""))
    return tuple(rows)


def _sentence(
    compared: Comparison,
    rows: Sequence[Row],
    faults: Sequence[str],
    broken: Sequence[str],
    band: float | None,
) -> str:
    """What is worse, else better, else as it was; then how far, and whether it may be chance."""
    logs = compared.logs
    over = f"in {logs[0]}" if len(logs) == 1 else f"over {number_of(len(logs), 'log')}"
    totals = [row for row in rows if row.log == TOTAL or len(logs) == 1]
    # Without a band the leading method, in all logs, under the stricter protocol decides.
    deciding = [*totals, *rows] if band is not None else totals[:1]
    head = min(deciding, key=lambda row: ["worse", "better", ""].index(row.mark), default=None)
    if faults and (head is None or head.mark != "worse"):  # a curve, an ID, a method gone
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        return "; ".join([faults[0] + more, *broken])
    if broken and not faults:
        return f"{'; '.join(broken)}; otherwise no worse"
    if head is None:
        return f"as good: {over}"
    changed = any("->" in change_text(rate) for row in rows for rate in (row.tpr, row.fpr))
    word = head.mark or ("as good" if changed else "unchanged")
    parts = [f"{word}: {head.text} {over if head in totals else f'in {head.log}'}"]
    names = [*dict.fromkeys(r.log for r in rows if r not in totals and r.mark == "worse")]
    if word == "worse" and names:
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        few = ", ".join(names[:MOST_NAMED])
        parts.append(f"worse on {len(names)} of {len(logs)} logs: {few}{more}")
    test = head.larger
    if head in totals and abs(test.worse_by) >= SAME:
        chance = "" if test.p <= SIGNIFICANT else ": other recordings may not show it"
        tested = f"p = {test.p:.2g} over {units_text(compared.after.units)}{chance}"
        parts.append(test.note if math.isnan(test.p) else tested)
    return "; ".join([*parts, *broken])


def write_comparison(folder: Path, compared: Comparison) -> tuple[str, ...]:
    """Write compare.csv; returns its name. Raises as `write_evaluation`."""
    check_folder(folder, ["evaluation.json", "compare.csv"])
    check_tables(folder, {"compare.csv": COMPARE})
    with writing(folder):
        write_table(folder / "compare.csv", compared.figures)
    return ("compare.csv",)
