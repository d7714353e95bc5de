"""What decided the results of a run, which shows whether an earlier program made them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from sonarrec import __version__

RESULTS_VERSION = 6
"""Kept by hand: one more with every change after which a log may give other tables, be it in how
logs are read or in how landmarks are recognised. Code that only moves leaves it as it is.
tests/results/test_identity.py asks for it when the tables on record change."""

PROGRAM = {"name": "sonarrec", "version": __version__}
"""The program that made a file, for run.toml and JSON documents."""
_SETTINGS = ("config", "sonar", "landmarks")
"""The tables of run.toml whose digest it states."""
_MODELS = ("stage3", "drawn")
"""The folders of the recogniser that hold a built-in model."""


@cache
def model_digest() -> str:
    """SHA-256, in hex, of the built-in models: of the data files of stage 3."""
    home = Path(__file__).parents[1] / "recogniser"
    files = [path for folder in _MODELS for path in (home / folder).iterdir() if path.is_file()]
    contents = [path.read_bytes() for path in files if path.suffix != ".py"]
    return hashlib.sha256(b"\0".join(sorted(contents))).hexdigest()


def settings_digest(run: Mapping[str, Any]) -> str:
    """SHA-256, in hex, of the settings, the stated geometry and the landmark set of a run.toml."""
    text = json.dumps({key: run.get(key) for key in _SETTINGS}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def identity(run: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of [program] that say what decided the results. run: the tables of run.toml."""
    return {
        "results_version": RESULTS_VERSION,
        "model_sha256": model_digest(),
        "settings_sha256": settings_digest(run),
    }


def why_outdated(run: Mapping[str, Any]) -> str:
    """Why this program may not give the results of a run.toml again; empty if it does, or if it did
    not make them."""
    program = run.get("program", {})
    if program.get("name") != PROGRAM["name"]:
        return ""
    now = identity(run)
    if (number := program.get("results_version")) != RESULTS_VERSION:
        numbers = f"results_version {'none' if number is None else number}, now {RESULTS_VERSION}"
        return f"made by another version of the program ({numbers})"
    if ".dev" in (version := str(program.get("version", ""))):  # its number may not be final
        return f"made by a version in development ({version})"
    if program.get("model_sha256") != now["model_sha256"]:
        return "made with another built-in model"
    if program.get("settings_sha256") != now["settings_sha256"]:
        return "the settings in run.toml were changed after the run"
    return ""
