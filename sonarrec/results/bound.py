"""The bound of a campaign: how many claims may be false, how surely, and with which settings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sonarrec.results.run_file import RunFile, flat
from sonarrec.tables.toml import Count, Share, from_table

SETTINGS = ("config", "landmarks", "model")
"""The tables of run.toml for which a bound holds."""
_PER_LOG = ("config.features.beam_width_deg", "features.beam_width_deg", "model.name")


@dataclass(frozen=True, slots=True)
class Bound:
    """[bound] of bound.toml, and of the run.toml of runs with its settings."""

    share: Share
    """Of a pass's claims that may be false, in the mean over passes with a claim."""
    confidence: Share
    passes: Count
    """Labelled ones with a claim at this `declare`."""
    false_share: Share
    """That share in these."""

    def text(self) -> str:
        """What it says, and when it holds."""
        return (
            f"in the mean pass at most {self.share:g} of the claims are false, with "
            f"{self.confidence:.0%} confidence ({self.false_share:.3g} in {self.passes} labelled "
            "passes); for passes with the sonar, site and objects of these"
        )


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """The settings that differ between two run.toml, but for what each log states of itself."""
    sides = []
    for table in (old, new):
        settings = json.loads(json.dumps({k: table[k] for k in SETTINGS if k in table}))
        sides.append({k: v for k, v in flat(settings) if k not in _PER_LOG})
    was, now = sides
    return [key for key in {**was, **now} if was.get(key) != now.get(key)]


def bound_of(run: RunFile) -> Bound | None:
    """The bound that a run.toml states. Raises SonarrecError if it is invalid."""
    if "bound" not in run.table:
        return None
    return from_table(Bound, run.table["bound"], str(run.path), section="bound")
