"""The least `declare` at which, by labelled passes, few enough claims are false: learn then test.

Angelopoulos, Bates et al., arXiv 2110.01052. That more than the wanted share of claims is false is
tested for each of DECLARES, from the highest down, so that the probability of rejecting any
hypothesis that is true is at most 1 - CONFIDENCE: one that is rejected hands its level on to the
next (the fallback procedure; Wiens, Pharmaceutical Statistics 2, 2003).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.config import Config, with_table
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.evaluation.behaviour import DECLARES
from sonarrec.evaluation.count import Counts
from sonarrec.nouns import follows
from sonarrec.results.bound import SETTINGS, Bound, differing
from sonarrec.results.run_file import read_run

CONFIDENCE = 0.95
STARTS = {0.99: 0.1, 0.97: 0.2, 0.9: 0.7}
"""Parts of 1 - CONFIDENCE with which a sequence of tests begins at a `declare`."""


def bound_table(counts: Counts, folders: Iterable[Path], share: float) -> dict[str, Any]:
    """The tables of bound.toml, for the leading method of `counts`. folders: of its results.

    Raises SonarrecError if there is no bound, with what it would take, or if it would be of several
    settings; UsageError for a method without tracks.
    """
    method = counts.methods[0]
    if not follows(method) or not counts.placed:
        raise UsageError(f"--bound needs a method with tracks, not {method}, and positions")
    first, *others = ((folder, _settings(folder, method)) for folder in folders)
    place, settings = first
    for folder, other in others:
        if keys := differing(settings, other):
            raise SonarrecError(
                f"no bound: {folder} was run with another {keys[0]} than {place}, and a bound is "
                "of one"
            )
    features = settings["config"]["features"]
    widths = {other["config"]["features"]["beam_width_deg"] for _, other in (first, *others)}
    found = (part.sums.get(("claimed", method)) for part in counts.parts)
    claims = [of_log for of_log in found if of_log is not None]
    declare, bound = least_declare(np.concatenate(claims), share, features["declare"])
    features |= {"declare": declare, "beam_width_deg": widths.pop() if len(widths) == 1 else 0.0}
    return {"bound": asdict(bound), **settings}


def _settings(folder: Path, method: str) -> dict[str, Any]:
    """The tables SETTINGS of a run.toml, with [config] of one method."""
    run, preset = read_run(folder / "run.toml"), method.partition(":")[2]
    tables = [table for table in run.configs if table.get("preset") == preset or not preset]
    if not tables:
        raise SonarrecError(f"no bound: {run.path} states no settings of {method}")
    name = tables[0].get("preset", "default")
    config = with_table(Config(preset=name), tables[0], str(run.path))
    return {key: run.table[key] for key in SETTINGS if key in run.table} | {
        "config": asdict(config)
    }


def least_declare(claims: IntArray, share: float, own: float) -> tuple[float, Bound]:
    """The least `declare` for which the bound holds, at least `own`, the one of the results.

    claims: (U, D + 1, 2) as of `behaviour.claimed`. Raises SonarrecError if there is none.
    """
    tested = [i for i, d in enumerate(DECLARES) if d > own] + [len(DECLARES)]
    declares = [*(DECLARES[i] for i in tested[:-1]), own]
    parts = [STARTS.get(d, 0.0) for d in declares]
    parts[-1] += 1 - sum(parts)
    found: tuple[float, Bound] | None = None
    carried = 0.0
    refusals: list[tuple[float, str]] = []
    for i, declare, part in zip(tested, declares, parts, strict=True):
        of_unit = claims[:, i].sum(axis=1)
        false = claims[of_unit > 0, i, 1] / of_unit[of_unit > 0]
        mean, passes = (float(false.mean()) if len(false) else 0.0), len(false)
        level = carried + part * (1 - CONFIDENCE)
        surprise = _divergence(mean, share)  # per pass
        carried = level if math.exp(-passes * surprise) <= level else 0.0
        if carried:
            found = declare, Bound(share, CONFIDENCE, passes, mean)
        elif passes:
            reachable = surprise > 0 and level > 0
            needed = -math.log(level) / surprise * len(claims) / passes if reachable else math.inf
            told = (
                f"of the claims at a declare of {declare:g} in {passes} passes {mean:.3g} are false"
            )
            refusals.append((needed, told))
    if found is not None:
        return found
    needed, told = min(refusals, default=(math.inf, "no pass has a claim"))
    more = "more passes like these would not do"
    if needed < math.inf:
        more = f"about {math.ceil(needed) - len(claims)} more passes like these would do"
    raise SonarrecError(f"no bound of {share:g}: {told}; {more}")


def _divergence(mean: float, share: float) -> float:
    """The exponent of Hoeffding's bound: n independent values of 0 to 1, whose expectation is
    `share` or more, have a mean of this or less with a probability of at most exp(-n times it)."""
    if mean >= share:
        return 0.0
    low = mean * math.log(mean / share) if mean else 0.0
    return low + (1 - mean) * math.log((1 - mean) / (1 - share))
