"""Columns of measurements in the table of sightings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.results.sightings import Sighting


@dataclass(frozen=True, slots=True)
class MeasuredColumn:
    """One column: a measurement of each sighting."""

    head: str
    name: str
    """A field of Sighting."""
    digits: int
    error: str = ""
    """The field of its standard error; "" if there is none."""

    def value(self, of: Sighting) -> str:
        """The value as text, "" if not known."""
        return self._text(of, self.name)

    def sigma(self, of: Sighting) -> str:
        """Its standard error as text, "" if not known."""
        return self._text(of, self.error) if self.error else ""

    def _text(self, of: Sighting, name: str) -> str:
        value = float(getattr(of, name))
        return "" if np.isnan(value) else f"{value:.{self.digits}f}"


MEASURED = (
    MeasuredColumn("range, m", "range_m", 3, "range_sigma_m"),
    MeasuredColumn("bearing, deg", "bearing_deg", 1, "bearing_sigma_deg"),
    MeasuredColumn("orientation, deg", "orientation_deg", 0, "orientation_sigma_deg"),
    MeasuredColumn("x, m", "x_m", 2),
    MeasuredColumn("y, m", "y_m", 2),
)
