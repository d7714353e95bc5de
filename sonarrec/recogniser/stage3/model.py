"""The appearance model: an additive model of the log odds of each ID, one curve per feature.

Log odds of an ID against 'none of these' = bias + sum over the features of a piecewise-linear
curve. A curve shows what its feature is worth, as a file of weights would not. That depends on the
beam's smear, so there are two sums, one for sharp and one for smeared pictures, and a weighted mean
of the two in between.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import SonarrecError, as_usage
from sonarrec.recogniser.stage3.description import FEATURES, SHARP, SMEARED
from sonarrec.tables.toml import Finite, brief, checked, from_table, length, parse_toml, read_text

BUILT_IN = Path(__file__).parent / "appearance.toml"


def smeared_share(smear: FloatArray) -> FloatArray:
    """(n,) weight of the curves for smeared pictures, 0 to 1; those for sharp ones have the rest.

    smear: (n,) the beam's standard deviation across the line of sight, in disc radii.
    """
    return np.asarray(np.clip((smear - SHARP) / (SMEARED - SHARP), 0, 1))


@dataclass(frozen=True)
class AppearanceModel:
    """An additive model over FEATURES, for sharp pictures and for smeared ones.

    bias: (2,) log odds, sharp and smeared. knots: per feature, (m,) rising abscissae. values: per
    feature, (2, m) the log odds there; beyond the ends a curve stays level.
    """

    bias: FloatArray
    knots: tuple[FloatArray, ...]
    values: tuple[FloatArray, ...]

    every_frame: ClassVar = False  # see Classifier in appearance.py

    def log_odds(self, features: FloatArray, smear: FloatArray) -> FloatArray:
        """(n, K) log odds of each ID against 'none of these'.

        features: (n, K, F). smear: (n,) as in smeared_share.
        """
        knots, values, least, most, offset = self._end_to_end
        abscissa = np.minimum(np.maximum(features, least), most) + offset
        sharp, smeared = (
            bias + np.interp(abscissa, knots, ordinates).sum(axis=2)
            for bias, ordinates in zip(self.bias, values, strict=True)
        )
        return np.asarray(sharp + smeared_share(smear)[:, None] * (smeared - sharp))

    @cached_property
    def _end_to_end(self) -> tuple[FloatArray, ...]:
        """All curves end to end as one, so that a single interpolation serves them all.

        Its knots and values; per feature the first knot, the last, and the offset of its curve.
        """
        least, most = (np.array([k[end] for k in self.knots]) for end in (0, -1))
        room = most - least + 1.0
        offset = np.cumsum(room) - room - least
        moved = [k + by for k, by in zip(self.knots, offset, strict=True)]
        return np.concatenate(moved), np.concatenate(self.values, axis=1), least, most, offset

    def probabilities(self, features: FloatArray, smear: FloatArray) -> FloatArray:
        """(n, K + 1): every ID, then 'none of these'; rows sum to 1. Arguments as log_odds."""
        odds = self.log_odds(features, smear)
        logits = np.concatenate([odds, np.zeros((len(odds), 1))], axis=1)
        logits -= logits.max(axis=1, keepdims=True)
        likely = np.exp(logits)
        return np.asarray(likely / likely.sum(axis=1, keepdims=True))

    def as_toml(self) -> str:
        """The model as read_model reads it."""
        sharp, smeared = self.bias
        lines = [f"bias = {sharp:.3f}", f"smeared_bias = {smeared:.3f}"]
        for name, knots, values in zip(FEATURES, self.knots, self.values, strict=True):
            lines += ["", f"[{name}]"]
            for key, numbers in zip(fields(_Curve), (knots, *values), strict=True):
                lines.append(f"{key.name} = [{', '.join(f'{float(v):.3f}' for v in numbers)}]")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class ModelFile:
    """A model with the text of the file that it came from."""

    name: str
    text: str
    model: AppearanceModel

    def as_table(self) -> dict[str, str]:
        """What run.toml keeps of it, so that a run can use it again."""
        digest = hashlib.sha256(self.text.encode()).hexdigest()
        return {"name": self.name, "sha256": digest, "text": self.text}


def read_model(path: Path) -> ModelFile:
    """A model from a TOML file. Raises UsageError if the file is not such a model."""
    with as_usage():
        text = read_text(path)
        return ModelFile(path.name, text, parse_model(text, str(path)))


def model_from_table(table: Mapping[str, Any], where: str) -> ModelFile:
    """The model in a table from ModelFile.as_table. Raises SonarrecError if it is not one."""
    try:
        name, text = table["name"], table["text"]
    except KeyError:
        raise SonarrecError(f"{where}: [model] needs name and text") from None
    for key, value in (("name", name), ("text", text)):
        checked(value, str, f"{where}: model.{key}")
    return ModelFile(name, text, parse_model(text, f"{where}: [model]"))


@cache
def built_in_model() -> AppearanceModel:
    """The model that is used if none is given; cached, since reading takes longer than a frame."""
    return read_model(BUILT_IN).model


@dataclass(frozen=True, slots=True)
class _Curve:
    """A feature's curve as its table states it."""

    at: Annotated[tuple[Finite, ...], length(1, 1000)]
    log_odds: Annotated[tuple[Finite, ...], length(1, 1000)]
    smeared_log_odds: Annotated[tuple[Finite, ...], length(1, 1000)]


_BIASES = ("bias", "smeared_bias")


def parse_model(text: str, where: str) -> AppearanceModel:
    """The model in a TOML text; `where` names it in errors (SonarrecError, if it is not one)."""
    table = parse_toml(text, where)
    known = (*_BIASES, *FEATURES)
    if wrong := [key for key in (*known, *table) if key not in known or key not in table]:
        raise SonarrecError(
            f"{where}: not an appearance model of this version (missing or unknown: "
            f"{brief(wrong[0])}); `sonarrec calibrate` writes one"
        )
    bias = np.array([checked(table[key], Finite, f"{where}: {key}") for key in _BIASES])
    curves = [from_table(_Curve, table[name], where, section=name) for name in FEATURES]
    knots = tuple(np.array(curve.at) for curve in curves)
    for name, curve in zip(FEATURES, curves, strict=True):
        sizes = {len(curve.at), len(curve.log_odds), len(curve.smeared_log_odds)}
        if len(sizes) > 1 or not (np.diff(curve.at) > 0).all():
            raise SonarrecError(
                f"{where}: [{name}] needs rising `at` and as many `log_odds` and `smeared_log_odds`"
            )
    values = tuple(np.array([curve.log_odds, curve.smeared_log_odds]) for curve in curves)
    return AppearanceModel(bias, knots, values)
