"""Every automatic guess about a recording: what finds it, by which constants, what states it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sonarrec.readers.decode.colour import find_map
from sonarrec.readers.decode.grey import grey_scale, holds_amplitudes
from sonarrec.readers.guess.height import height_from_images
from sonarrec.readers.guess.names import in_order, times_in_names
from sonarrec.readers.guess.order import looks_beam_major
from sonarrec.readers.guess.plausible import Plausibility


@dataclass(frozen=True, slots=True)
class Guess:
    """One guess. A key of the geometry that is stated goes before it.

    constants: the names of its bounds, in the module of the function. keys: of the geometry, which
    state what is guessed; empty if the guess is only told, or follows from names alone.
    """

    what: str
    function: Callable[..., Any]
    constants: tuple[str, ...]
    keys: tuple[str, ...]


GUESSES = (
    Guess("colour map", find_map, ("_NEAR", "_NEAR_IF_MIXED", "_BRIGHT"), ("colour_map",)),
    Guess("amplitudes", holds_amplitudes, ("_AMPLITUDES", "_LEAST_SPECKLE"), ("pixel_scale",)),
    Guess(
        "grey scale", grey_scale, ("_MEDIAN_AT", "_NEXT_TO_BLACK"), ("pixel_scale", "full_scale")
    ),
    Guess("beam order", looks_beam_major, (), ("beam_order",)),
    Guess("height", height_from_images, ("HALF_BEAM_DEG", "LIT", "LEAST"), ("height_m",)),
    Guess("contradictions", Plausibility.contradictions, ("_OUTSIDE", "_CUT"), ()),
    Guess("order of images", in_order, ("_GAP",), ()),
    Guess("times in names", times_in_names, ("LEAST_STEP_NS",), ()),
)
