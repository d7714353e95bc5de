"""Scores of results, and what got better or worse: `sonarrec.evaluate` and `sonarrec.compare`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sonarrec.advice.results import of_results
from sonarrec.errors import refuse_url
from sonarrec.evaluation import compare as comparing
from sonarrec.evaluation.compare import Comparison
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.pairs import Pair, read_pairs
from sonarrec.evaluation.rows import ScoringOptions, scoring_options
from sonarrec.evaluation.write import Evaluation, write_evaluation
from sonarrec.sonar.stated import Sonar


def evaluate(
    results: str | Path = "sonarrec_out",
    ground_truth: str | Path | None = None,
    *,
    pairs: str | Path | None = None,
    method: str | Sequence[str] = (),
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    within_m: float | None = None,
    labelled_only: bool = False,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    out: str | Path | None = None,
) -> Evaluation:
    """Score results, of one log or of several, against ground truth.

    `sonarrec help evaluate` defines claims and both protocols. Of several results of one
    recording the first counts. Warns where part of the input is not used or in doubt.

    Parameters
    ----------
    results : str or Path, default "sonarrec_out"
        The folder of one log's results, or a folder of such folders.
    ground_truth : str or Path, optional
        One table for all logs, or a folder with NAME.gt.csv of each. Default: NAME.gt.csv, or
        gt.csv, in the folder of each log.
    pairs : str or Path, optional
        A CSV that names results and truth of each log, in place of `results` and `ground_truth`.
    method : str or sequence of str, optional
        The methods to score. Default: all, the framework first.
    min_visible : float, default 0.9
        Protocol strict counts a landmark if at least this share of its disc is in view, 0 to 1.
    tolerance_s : float, optional
        How far, in s, a row of truth matched by time may lie from its frame. Default: half the
        time between frames.
    within_m : float, optional
        Protocol strict counts a claim as right within this distance in m. Default: half a disc
        or plate.
    labelled_only : bool, default False
        Only frames count that have a row of truth, of a landmark or `none`.
    landmarks : str, optional
        A landmark set, in place of that of run.toml.
    sonar : Sonar or mapping, optional
        Geometry that takes precedence over run.toml, with the keys and units of sonar.toml.
    out : str or Path, optional
        A folder for the files of `sonarrec evaluate`. Default: none is written.

    Returns
    -------
    Evaluation
        `table` has a row per method; rates are 0 to 1, errors m and deg. `figures`, `tests`,
        `confusion`, `roc`, `passes` and `mistakes` are the tables of the files.

    Raises
    ------
    SonarrecError
        Files cannot be used, or have no frame in common.
    UsageError
        An option is invalid, or no truth is found.

    Examples
    --------
    >>> scores = sonarrec.evaluate("sample_data/regression/pan", "sample_data/pan.gt.csv")
    >>> scores.table.loc["framework", ["strict TPR", "strict FPR"]].round(2)
    strict TPR    0.99
    strict FPR    0.00
    Name: framework, dtype: float64
    """
    scoring = scoring_options(
        method, min_visible, tolerance_s, landmarks, sonar, within_m, labelled_only
    )
    logs = results if pairs is None else read_pairs(Path(pairs))
    evaluation = evaluate_logs(logs, ground_truth, scoring, of_results)
    for line in evaluation.unused:
        warnings.warn(line, stacklevel=2)
    if out is not None:
        write_evaluation(Path(refuse_url(out)), evaluation)
    return evaluation


def compare(
    old: str | Path,
    new: str | Path,
    ground_truth: str | Path | Sequence[Pair] | None = None,
    options: ScoringOptions | None = None,
    *,
    pairs: str | Path | None = None,
    **scoring: Any,
) -> Comparison:
    """Compare old and new results by their scores on common frames; writes nothing.

    Logs are read one at a time, so memory does not grow with their number. A log that cannot be
    compared is left out if there are others.

    Parameters
    ----------
    old, new : str or Path
        Folders of results. Their logs are paired by name; if each holds one log, these are paired.
    ground_truth : str, Path or sequence of Pair, optional
        One table for all logs, a folder with NAME.gt.csv of each, or pairs. Default: NAME.gt.csv,
        or gt.csv, in the folder of each log.
    options : ScoringOptions, optional
        How results are scored, in place of `scoring`.
    pairs : str or Path, optional
        A CSV that names the truth of each log.
    **scoring
        `method`, `min_visible`, `tolerance_s`, `within_m`, `labelled_only`, `landmarks` and
        `sonar` as in `evaluate`.

    Returns
    -------
    Comparison
        `verdict` is a sentence; `figures` has a row per rate, with its test.

    Raises
    ------
    SonarrecError
        No log can be compared, or the one truth of all logs cannot be read.
    UsageError
        An option is invalid.
    """
    options = options or scoring_options(**scoring)
    ground_truth = Path(ground_truth) if isinstance(ground_truth, str) else ground_truth
    truth = read_pairs(Path(pairs)) if pairs else ground_truth
    return comparing.compare(Path(old), Path(new), truth, options, of_results)
