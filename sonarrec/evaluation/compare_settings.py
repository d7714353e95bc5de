"""Differences in the run.toml of two runs: settings, version, geometry, landmark set."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from sonarrec.results.run_file import RunFile, flat

NOT_STATED = "not stated"
_LONGEST = 60
# Keys that differ between equal runs, or that are reported elsewhere.
_PASSED_OVER = {
    *("finished", "program.name", "program.methods", "input.name", "input.path", "input.place"),
    *(
        "input.bytes",
        "input.sha256",
        "input.frames_processed",
        "input.frames_unusable",
        "input.candidates",
    ),
    *("input.estimates", "input.sightings", "input.problems"),
    *("ran_on.processor", "ran_on.numpy", "ran_on.opencv"),
}


@dataclass(frozen=True, slots=True)
class SettingChange:
    """A key of run.toml that differs, its values as text, and the logs in which it differs."""

    key: str
    """Named as for `--set`; if there are several presets, with the preset in front."""
    old: str
    new: str
    logs: tuple[str, ...]


def changed_settings(runs: Iterable[tuple[str, RunFile, RunFile]]) -> list[SettingChange]:
    """The differences between the old and the new run.toml of each log (name, old, new).

    Logs without a run.toml on one side are left out.
    """
    presets: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for name, before, after in runs:
        if not before.table or not after.table:
            continue
        old, new = (_compared_keys(run) for run in (before, after))
        for key in dict.fromkeys((*old, *new)):
            if old.get(key) != new.get(key) and not _is_echo(key, old, new):
                presets[key, *_texts(old, new, key)].append(name)
    return [SettingChange(*change, tuple(logs)) for change, logs in presets.items()]


def _compared_keys(run: RunFile) -> dict[str, Any]:
    return {key: value for key, value in flat(run.table) if key not in _PASSED_OVER}


def _is_echo(key: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> bool:
    """Whether a key of [fan] changed only because the key of [sonar] did."""
    stated = key.replace("fan.", "sonar.", 1)
    return key.startswith("fan.") and old.get(stated) != new.get(stated)


def _texts(old: Mapping[str, Any], new: Mapping[str, Any], key: str) -> tuple[str, str]:
    was, now = (_text(side[key]) if key in side else NOT_STATED for side in (old, new))
    return (was, now) if was != now else (was, "other values")


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
