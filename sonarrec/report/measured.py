"""The columns of what was measured in each sighting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.results.sightings import Sighting


@dataclass(frozen=True, slots=True)
class Measured:
    """A column of what was measured in each sighting."""

    head: str
    name: str
    """A field of Sighting."""
    digits: int
    error: str = ""
    """The field of its standard error, "" without."""

    def value(self, of: Sighting) -> str:
        """As told, "" where not known."""
        return self._told(of, self.name)

    def sigma(self, of: Sighting) -> str:
        """Its standard error as told, "" where not known."""
        return self._told(of, self.error) if self.error else ""

    def _told(self, of: Sighting, name: str) -> str:
        value = float(getattr(of, name))
        return "" if np.isnan(value) else f"{value:.{self.digits}f}"


MEASURED = (
    Measured("range, m", "range_m", 3, "range_sigma_m"),
    Measured("bearing, deg", "bearing_deg", 1, "bearing_sigma_deg"),
    Measured("orientation, deg", "orientation_deg", 0, "orientation_sigma_deg"),
    Measured("x, m", "x_m", 2),
    Measured("y, m", "y_m", 2),
)
