"""Judges a described disc: one curve per feature, added up to the log odds of each ID.

Log odds of an ID against 'none of these' = bias + sum over the features of a piecewise-linear
curve. A curve shows at a glance what its feature is worth, which a file of weights would not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from sonarrec.files.toml import Finite, checked, from_table, length, parse_toml, read_text, shown
from sonarrec.recogniser.stage3_features.description import FEATURES
from sonarrec.records import FloatArray, UsageError

BUILT_IN = Path(__file__).parent / "appearance.toml"


@dataclass(frozen=True)
class AppearanceModel:
    """An additive model over FEATURES.

    knots, values: per feature, (m,) rising abscissae and the log odds there; beyond the ends a
    curve stays level. bias: log odds that are no feature's.
    """

    bias: float
    knots: tuple[FloatArray, ...]
    values: tuple[FloatArray, ...]

    def log_odds(self, features: FloatArray) -> FloatArray:
        """(n, K) of each ID against 'none of these'. features: (n, K, F)."""
        knots, values, least, most, apart = self._end_to_end
        held = np.minimum(np.maximum(features, least), most)
        return np.asarray(self.bias + np.interp(held + apart, knots, values).sum(axis=2))

    @cached_property
    def _end_to_end(self) -> tuple[FloatArray, ...]:
        """All curves as one, each moved beyond the one before: a single look-up serves them all.

        Its knots and values; per feature its first knot, its last, and how far it was moved.
        """
        least, most = (np.array([k[end] for k in self.knots]) for end in (0, -1))
        room = most - least + 1.0
        apart = np.cumsum(room) - room - least
        moved = [k + by for k, by in zip(self.knots, apart, strict=True)]
        return np.concatenate(moved), np.concatenate(self.values), least, most, apart

    def probabilities(self, features: FloatArray) -> FloatArray:
        """(n, K + 1): every ID, then 'none of these'; rows sum to 1. features: (n, K, F)."""
        odds = self.log_odds(features)
        logits = np.concatenate([odds, np.zeros((len(odds), 1))], axis=1)
        logits -= logits.max(axis=1, keepdims=True)
        likely = np.exp(logits)
        return np.asarray(likely / likely.sum(axis=1, keepdims=True))

    def as_toml(self) -> str:
        """The model as load_model reads it."""
        lines = [f"bias = {self.bias:.3f}"]
        for name, knots, values in zip(FEATURES, self.knots, self.values, strict=True):
            lines += ["", f"[{name}]"]
            for key, numbers in (("at", knots), ("log_odds", values)):
                lines.append(f"{key} = [{', '.join(f'{float(v):.3f}' for v in numbers)}]")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class ModelFile:
    """A model with the text of the file that it came from."""

    name: str
    text: str
    model: AppearanceModel

    def as_table(self) -> dict[str, str]:
        """What run.toml keeps of it: all that a run needs to use it again."""
        digest = hashlib.sha256(self.text.encode()).hexdigest()
        return {"name": self.name, "sha256": digest, "text": self.text}


def read_model(path: Path) -> ModelFile:
    """A model from a TOML file. Raises UsageError where the file is not such a model."""
    text = read_text(path, UsageError)
    return ModelFile(path.name, text, parse_model(text, str(path)))


def model_from_table(table: Mapping[str, Any], where: str) -> ModelFile:
    """The model that ModelFile.as_table wrote down. Raises UsageError where it is none."""
    try:
        name, text = table["name"], table["text"]
    except KeyError:
        raise UsageError(f"{where}: [model] needs name and text") from None
    for key, value in (("name", name), ("text", text)):
        checked(value, str, f"{where}: model.{key}", UsageError)
    return ModelFile(name, text, parse_model(text, f"{where}: [model]"))


def load_model(path: Path = BUILT_IN) -> AppearanceModel:
    """The model in a TOML file (default: the built-in one). Raises UsageError as read_model."""
    return read_model(path).model


@dataclass(frozen=True, slots=True)
class _Curve:
    """A feature's curve as its table states it."""

    at: Annotated[tuple[Finite, ...], length(1, 1000)]
    log_odds: Annotated[tuple[Finite, ...], length(1, 1000)]


def parse_model(text: str, where: str) -> AppearanceModel:
    """The model in a TOML text; `where` names it in errors.

    Raises UsageError where the text is not such a model.
    """
    table = parse_toml(text, where, UsageError)
    known = ("bias", *FEATURES)
    if wrong := [key for key in (*known, *table) if key not in known or key not in table]:
        raise UsageError(
            f"{where}: not an appearance model (missing or unknown: {shown(wrong[0])}); "
            "`sonarrec calibrate` writes one"
        )
    bias = checked(table["bias"], Finite, f"{where}: bias", UsageError)
    curves = [
        from_table(_Curve, table[name], where, section=name, error=UsageError) for name in FEATURES
    ]
    knots = tuple(np.array(curve.at) for curve in curves)
    values = tuple(np.array(curve.log_odds) for curve in curves)
    for name, at, odds in zip(FEATURES, knots, values, strict=True):
        if at.shape != odds.shape or not (np.diff(at) > 0).all():
            raise UsageError(f"{where}: [{name}] needs rising `at` and as many `log_odds`")
    return AppearanceModel(bias, knots, values)
