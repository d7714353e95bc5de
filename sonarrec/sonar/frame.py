"""The records that modules exchange, and times as text. Units and shapes are stated here, once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal, Protocol

if TYPE_CHECKING:  # a command's --help needs no numpy, whose import takes longer than all the rest
    from sonarrec.arrays import BoolArray, ByteImage, FloatArray, FloatImage


@dataclass(frozen=True, slots=True)
class Fan:
    """Geometry of one Cartesian fan image, far range at the top.

    A point at slant range R (m) and bearing b (deg, positive to the right) lies at
    column = apex_column + R sin b / metres_per_pixel,
    row = apex_row - R cos b / metres_per_pixel, pixel centres at whole numbers.
    """

    rows: int
    columns: int
    metres_per_pixel: float
    apex_column: float
    apex_row: float
    range_min_m: float
    range_max_m: float
    bearing_min_deg: float
    bearing_max_deg: float
    tilt_deg: float
    height_m: float | None

    @property
    def window_m(self) -> float:
        """Length of the range window in metres."""
        return self.range_max_m - self.range_min_m


Clock = Literal["log", "publish", "header"]
"""Which of the times in Stamps names a frame."""
ColourMap = Literal[
    "luminance", "hot", "inferno", "jet", "magma", "ocean", "parula", "plasma", "rainbow", "turbo",
    "viridis", "hot_bgr", "inferno_bgr", "jet_bgr", "magma_bgr", "ocean_bgr", "parula_bgr",
    "plasma_bgr", "rainbow_bgr", "turbo_bgr", "viridis_bgr",
]  # fmt: skip
"""The colours in which a picture of the sonar was drawn; luminance: grey, or none of the others.
In those of `_bgr` red and blue are exchanged."""


@dataclass(frozen=True, slots=True)
class Stamps:
    """The times that a log states for one frame, in ns; None for those it does not state."""

    log: int | None = None
    """When it was recorded, which is the frames' order."""
    publish: int | None = None
    """When it was sent."""
    header: int | None = None
    """The stamp inside the message."""


NO_STAMPS = Stamps()


class PolarImages(Protocol):
    """How a log's polar images (rows = range bins, nearest first; columns = beams) fill its fan."""

    shape: tuple[int, int]
    """(range bins, beams) of the images."""
    bin_m: float
    """Metres of slant range from one bin to the next, on average."""
    ranges_m: FloatArray
    """(range bins,) their slant ranges."""
    beam_deg: float
    """Degrees from one beam to the next, on average."""

    def __call__(self, polar: ByteImage) -> ByteImage:
        """(range bins, beams) uint8 to (fan.rows, fan.columns) uint8; 0 outside the fan."""
        ...

    def pixel(
        self, range_m: FloatArray, bearing_deg: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """(beam, range bin, whether the images show it) of slant ranges (m), bearings (deg).

        Half a bin beyond the outermost centres still counts as shown. The arguments have one shape.
        """
        ...


BeamOrder = Literal["range-major", "beam-major"]


@dataclass(frozen=True, slots=True)
class Frame:
    """One ping, with the fan in which it lies, as the stages take it."""

    index: int
    """0-based position in the log (unusable frames keep their number)."""
    timestamp_ns: int
    """Time in ns; if the log carries none, from the index and the frame rate."""
    pixels: ByteImage
    """uint8, log-compressed intensity: the fan image or, if there is `polar`, a polar image (range
    bins, beams)."""
    fan: Fan
    stamps: Stamps = NO_STAMPS
    """All times that the log states for the frame."""
    polar: PolarImages | None = None
    """How a polar image fills the fan."""
    stretch: int = 0
    """Number of its stretch, from 0 (see stretches.py)."""

    @property
    def image(self) -> ByteImage:
        """The fan image, (fan.rows, fan.columns) uint8; of polar pixels it is made at each call."""
        return self.pixels if self.polar is None else self.polar(self.pixels)


@dataclass(frozen=True, slots=True)
class Motion:
    """How the sonar moved from one frame to the next."""

    pan_deg: float
    """By how much its heading changed, positive to the right."""
    right_m: float = 0.0
    ahead_m: float = 0.0
    """right_m, ahead_m: how far it moved, in the directions that were right and ahead before."""
    pan_sigma_deg: float = 0.0
    right_sigma_m: float = 0.0
    ahead_sigma_m: float = 0.0
    """The sigmas: standard errors of these; 0 if poses are given."""
    known: bool = True
    """False if the motion was not measured; then sigmas are wide."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Stage 1: the candidates of one frame."""

    score_map: FloatImage
    """(rows, columns) float32, 0 to 1, over the working plane, with a value for each block of step
    x step pixels."""
    positions: FloatArray
    """(n, 2) float, (column, row) in plane pixels."""
    scores: FloatArray
    """(n,), best first."""
    mean: FloatImage
    sigma: FloatImage
    """mean, sigma: float32, mean and standard deviation (above 0) of the grey levels in each
    pixel's surroundings, on coarse grids; see CandidateSelector.levels."""
    step: int = 1


def follows(method: str) -> bool:
    """Whether a method's object numbers mean the same object from one frame to the next."""
    return method.partition(":")[0] != "smi"


@dataclass(frozen=True, slots=True)
class Estimate:
    """One method's estimate of one object in one frame: a row of estimates.csv."""

    method: str
    object: int
    x_px: float
    y_px: float
    """x_px, y_px: centre in fan pixels."""
    range_m: float
    """Slant range."""
    bearing_deg: float
    """Positive to the right."""
    orientation_deg: float
    """Where the first sector begins, counter-clockwise from the image's right, seen from above; NaN
    where unknown."""
    existence: float
    """Probability that an object is there, 0 to 1."""
    probabilities: FloatArray
    """(K + 1,) one per ID in the landmark set's order, then 'none of these'; sums to 1."""
    landmark: int
    """The most probable ID."""
    score: float
    """0 to 1, what a ROC threshold sweeps."""
    declared: bool
    """The method claims the ID at its operating point."""
    range_sigma_m: float = math.nan
    bearing_sigma_deg: float = math.nan
    orientation_sigma_deg: float = math.nan
    """range_sigma_m, bearing_sigma_deg, orientation_sigma_deg: standard errors, NaN if the method
    has none."""
    sight_deg: float = 0.0
    """By how many degrees, counter-clockwise seen from above, the line of sight to the object has
    rotated over the floor since its track began; 0 if the sonar only pans."""
    episode: int = 0
    """A track that comes back into view and looks different begins a new episode."""
    in_view: bool = True
    """Whether enough of the disc is inside the fan (continuity.least_in_view)."""
    enough_evidence: bool = True
    """As in Beliefs. This, sight_deg, episode and in_view are not written."""
    read: str = ""
    """The symbol as stage 3 read it, a digit for each direction as columns.csv says; or empty."""
    corners: FloatArray | None = None
    """Of a drawn plate that was seen, (4, 2) slant range (m) and bearing (deg), clockwise in the
    image from the far left on."""

    @property
    def followed(self) -> bool:
        """Whether the object is one that is followed from frame to frame."""
        return self.object >= 0 and follows(self.method)


@dataclass(frozen=True, slots=True)
class FrameResult:
    """The results of one frame: a row of frames.csv and its rows of estimates.csv."""

    index: int
    timestamp_ns: int
    candidates: int
    tracks: int
    estimates: tuple[Estimate, ...]
    motion: Motion | None = None
    """Of the sonar since the frame before; None for the first frame, and if not measured."""
    stretch: int = 0
    """As in Frame."""


YEAR_2000_NS = 946_684_800 * 10**9


def is_date(timestamp_ns: int) -> bool:
    """Whether a time counts from 1970: then it is after the year 2000.

    A sonar's clock that was never set counts from when the sonar was switched on.
    """
    return timestamp_ns >= YEAR_2000_NS


def date_text(timestamp_ns: int, decimals: int = 0) -> str:
    """Date and time of day in UTC, cut to so many decimals: "2024-05-01 12:30:00.25"."""
    return _text(timestamp_ns, "%Y-%m-%d %H:%M:%S", decimals)


def time_text(timestamp_ns: int, decimals: int = 0) -> str:
    """Time of day in UTC, cut to so many decimals: "12:30:00.25"."""
    return _text(timestamp_ns, "%H:%M:%S", decimals)


def _text(timestamp_ns: int, form: str, decimals: int) -> str:
    seconds, rest = divmod(timestamp_ns, 10**9)
    fraction = f".{rest:09d}"[: decimals + 1] if decimals else ""
    return f"{datetime.fromtimestamp(seconds, UTC):{form}}{fraction}"
