"""Options of scoring."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonarrec.errors import UsageError
from sonarrec.sonar import Sonar


@dataclass(frozen=True, slots=True)
class ScoringOptions:
    """How results are read and compared with truth."""

    min_visible: float = 0.9
    """Under protocol strict a landmark counts if at least this share of its disc is in view."""
    tolerance_s: float | None = None
    """For truth matched by time; None: half the time between frames."""
    landmarks: str | None = None
    """Landmark set, in place of that of run.toml."""
    sonar: Sonar | None = None
    """Geometry that takes precedence over run.toml."""

    def check(self) -> None:
        """Raises UsageError if an option is invalid."""
        if not 0 <= self.min_visible <= 1:
            raise UsageError(
                f"--min-visible is a share of the disc, 0 to 1, not {self.min_visible:g}"
            )
        if self.tolerance_s is not None and not 0 <= self.tolerance_s < math.inf:
            raise UsageError(
                f"--tolerance is a time in seconds, 0 or more, not {self.tolerance_s:g}"
            )
