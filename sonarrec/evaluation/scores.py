"""`sonarrec.evaluate`: the evaluation as tables, for programs and notebooks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from sonarrec.errors import number_of
from sonarrec.evaluation.counting.passes import UnitKind
from sonarrec.evaluation.counting.pooled import Pooled, PooledScored
from sonarrec.evaluation.evaluate import evaluate_many
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.summary import Summary, summarise
from sonarrec.evaluation.write import tables
from sonarrec.sonar import Sonar


@dataclass(frozen=True, slots=True, repr=False)
class Scores:
    """The result of `evaluate`: each table has the columns of the file of its name."""

    pooled: Pooled
    summary: Summary

    @property
    def scored(self) -> tuple[PooledScored, ...]:
        """Counts and curves of every method under every protocol."""
        return self.pooled.scored

    @property
    def notes(self) -> tuple[str, ...]:
        """What is remarkable, a line each."""
        return (*self.pooled.notes, *self.summary.notes)

    @property
    def unused(self) -> tuple[str, ...]:
        """Input that could not be used, a line each."""
        return self.pooled.unused

    @property
    def confusion(self) -> pd.DataFrame:
        """Rates and counts, per ID and in total."""
        return self._table("confusion.csv")

    @property
    def per_log(self) -> pd.DataFrame:
        """The same for each log."""
        return self._table("per_log.csv")

    @property
    def figures(self) -> pd.DataFrame:
        """All figures with their 95 % intervals."""
        return self._table("figures.csv")

    @property
    def tests(self) -> pd.DataFrame:
        """The differences of each two methods, with intervals and p-values."""
        return self._table("tests.csv")

    @property
    def roc(self) -> pd.DataFrame:
        """The corners of every curve."""
        return self._table("roc.csv")

    @property
    def passes(self) -> pd.DataFrame:
        """How each method did in each pass of a landmark."""
        return self._table("passes.csv")

    @property
    def reliability(self) -> pd.DataFrame:
        """Stated probabilities and how often they were right."""
        return self._table("reliability.csv")

    def _table(self, name: str) -> pd.DataFrame:
        header, rows = tables(self.pooled, self.summary)[name]
        return pd.DataFrame(rows, columns=list(header))

    def __repr__(self) -> str:
        of = f"{number_of(len(self.pooled.logs), 'log')}, {number_of(self.pooled.frames, 'frame')}"
        return f"<Scores of {of}: {'; '.join(map(repr, self.scored))}>"


def evaluate(
    results: str | Path,
    ground_truth: str | Path | None = None,
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
    unit: UnitKind | None = None,
    jobs: int | None = 1,
) -> Scores:
    """Score a results folder (of one log, or of several) against gt.csv.

    The figures, intervals and tests are those of `sonarrec evaluate`.

    Without ground_truth the NAME.gt.csv, or gt.csv, beside each log is taken.
    Of several results of one recording the first counts.

    A claim is an estimate that is declared (operating point) or whose score reaches the
    threshold (curves). A row with visible 0 is no row.

    Protocol "paper", per frame and ID: in view and claimed = TP, each further claim of it one TP
    more; in view and not claimed = FN; not in view and claimed, however often, = FP; else TN.
    Position plays no part. Half a disc or more is in view, anything less is not: as in the paper,
    every frame counts. Count.tpr_once is the TPR without the further claims.

    Protocol "strict": a landmark with visible >= min_visible is a positive; with less it is
    ignored. A claim belongs to the truth of its ID that is nearest in that frame, if
    its centre is within half a disc diameter of it in the fan plane. The first claim of a
    positive (the one of highest score) is TP; every further one, and every claim that belongs to
    no truth, is FP. A positive without a claim is FN, even if its ID is claimed elsewhere
    (FN and FP). Claims of a partly visible landmark are not counted. TN: a frame and ID of which
    nothing shows and which is not claimed. So an FP replaces a TN the first time an absent ID is
    claimed in a frame, and is an entry of its own otherwise: FPR = FP / (FP + TN) stays within
    0 to 1 and no false claim is free.

    unit: what is independent, "pass" or "log"; default: logs if there are ten or more. jobs: how
    many logs are read at once, each in its own process.
    Raises SonarrecError where files cannot be used or have no frame in common.
    """
    options = ScoringOptions(min_visible, tolerance_s, landmarks, sonar)
    pooled = evaluate_many(results, ground_truth, options, jobs=jobs)
    return Scores(pooled, summarise(pooled, unit))
