"""The reader's weights: those that come with the program, and those that `calibrate` adapted.

A file of `calibrate` holds the last layer alone, as a TOML text with one list a name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from sonarrec.errors import SonarrecError, as_usage
from sonarrec.recogniser.stage3.reader import LAST_LAYER, WEIGHT_STEPS, Weights
from sonarrec.tables.toml import Finite, brief, checked, length, parse_toml, read_text

BUILT_IN = Path(__file__).parent / "reader.npz"


@cache
def built_in_weights() -> Weights:
    """The weights that are used if none are given; cached, since reading takes longer than a
    frame."""
    with np.load(BUILT_IN) as file:
        return {name: file[name] / WEIGHT_STEPS for name in file.files}


@cache
def built_in_digest() -> str:
    """What tells one built-in reader from another."""
    return hashlib.sha256(BUILT_IN.read_bytes()).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class ModelFile:
    """A model with the text of the file that it came from."""

    name: str
    text: str
    weights: Weights

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


def as_toml(weights: Weights) -> str:
    """The last layer as parse_model reads it."""
    lines = [f'reader = "{built_in_digest()}"']
    for name in LAST_LAYER:
        values = np.rint(weights[name] * WEIGHT_STEPS) / WEIGHT_STEPS
        lines.append(f"{name} = [{', '.join(f'{float(v):.9g}' for v in values)}]")
    return "\n".join(lines) + "\n"


def parse_model(text: str, where: str) -> Weights:
    """The built-in weights with the last layer of a TOML text; `where` names it in errors.

    Raises SonarrecError if it is not one, or adapts another reader.
    """
    table = parse_toml(text, where)
    known = ("reader", *LAST_LAYER)
    if wrong := [key for key in (*known, *table) if key not in known or key not in table]:
        raise SonarrecError(
            f"{where}: not a model of this version (missing or unknown: {brief(wrong[0])}); "
            "`sonarrec calibrate` makes one"
        )
    if table["reader"] != built_in_digest():
        raise SonarrecError(
            f"{where}: adapts the reader of another version of sonarrec; make it again with "
            "`sonarrec calibrate`"
        )
    weights = dict(built_in_weights())
    for name in LAST_LAYER:
        size = len(weights[name])
        kind = Annotated[tuple[Finite, ...], length(size, size)]
        values = checked(table[name], kind, f"{where}: {name}")
        weights[name] = np.array(values)
    return weights
