"""What may be asked of every scoring."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonarrec.records import UsageError
from sonarrec.sonar import Sonar


@dataclass(frozen=True, slots=True)
class ScoringOptions:
    """How results are read and held against their truth."""

    min_visible: float = 0.9
    """Share of the disc in view from which a landmark counts."""
    tolerance_s: float | None = None
    """For truth matched by time; default, half the time between frames."""
    landmarks: str | None = None
    """A set in place of the one in run.toml."""
    sonar: Sonar | None = None
    """Geometry that goes before what run.toml says."""

    def check(self) -> None:
        """Raises UsageError where one of them cannot be meant."""
        if not 0 <= self.min_visible <= 1:
            raise UsageError(
                f"--min-visible is a share of the disc, 0 to 1, not {self.min_visible:g}"
            )
        if self.tolerance_s is not None and not 0 <= self.tolerance_s < math.inf:
            raise UsageError(
                f"--tolerance is a time in seconds, 0 or more, not {self.tolerance_s:g}"
            )
