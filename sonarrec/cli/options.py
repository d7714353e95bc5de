"""Options that several commands share: inputs, truth, scoring, settings, output, servers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sonarrec.cli.groups import (
    ANY,
    FILE,
    Decorator,
    FiniteRange,
    as_one,
    file_names,
    in_input,
    in_output,
    in_scoring,
    in_settings,
    names_of,
)
from sonarrec.cli.options_log import sonar_file, stated_in
from sonarrec.errors import UsageError

if TYPE_CHECKING:
    from sonarrec.config import Config
    from sonarrec.evaluation.compare import Limits
    from sonarrec.evaluation.match import ScoringOptions


# Results and truth


def _landmark_sets() -> list[str]:
    from sonarrec.landmarks import BUILT_IN

    return sorted(file.stem for file in BUILT_IN.glob("*.toml"))


def _presets() -> Iterable[str]:
    from sonarrec.config import PRESETS

    return PRESETS


def _settings() -> list[str]:
    from sonarrec.config import setting_names

    return [f"{name}=" for name in setting_names()]


landmark_sets = names_of(_landmark_sets, files=True)
landmarks = in_input(
    "--landmarks",
    shell_complete=landmark_sets,
    help="Landmark set: a built-in name or a TOML file.  "
    "[default: that of the run.toml that is read, or landmarks.toml beside the log; else basin]",
)
pairs = in_input(
    "--pairs",
    type=FILE,
    help="In place of RESULTS and truth: a CSV with the columns results,ground_truth[,log], a row "
    "per log. With --compare: the truth of each log.",
)


def _one(_: click.Context, __: click.Parameter, methods: tuple[str, ...]) -> str | None:
    if len(methods) > 1:
        raise UsageError(f"--method: this command takes one method, not {', '.join(methods)}")
    return methods[0] if methods else None


_LEADING = "framework, else the first with tracks"
method = in_input(
    "--method",
    multiple=True,
    callback=_one,
    metavar="NAME",
    help=f"Method of estimates.csv.  [default: {_LEADING}]",
)
methods = in_scoring(
    "--method methods",
    multiple=True,
    metavar="NAME",
    help="Method of estimates.csv; repeatable, the first leads.  [default: all]",
)
model = in_input(
    "--model",
    type=FILE,
    help="Appearance model that `sonarrec calibrate` wrote.  [default: built in]",
)


def frames(text: str, default: str | None = None) -> Decorator:
    """--frames. text: what is done with these frames. default: in words; None: all frames."""
    text = f"{text} A or B may be left out." + (f"  [default: {default}]" if default else "")
    return in_input("--frames", metavar="A:B", help=text)


def ground_truth(text: str) -> Decorator:
    """--ground-truth. text: what it is for."""
    return in_input("--ground-truth", type=FILE, help=f"{text} Columns: sonarrec help truth.")


def compare(text: str) -> Decorator:
    """--compare OLD NEW. text: what is made of the two."""
    kind = ANY, ANY
    words: dict[str, Any] = {"metavar": "OLD NEW", "shell_complete": file_names, "help": text}
    return in_input("--compare", type=kind, **words)


_SCORING = {
    "min_visible": in_scoring(
        "--min-visible",
        type=float,
        default=0.9,
        help="Strict: least share of the disc in view; with less a landmark is ignored.",
    ),
    "within_m": in_scoring(
        "--within within_m",
        type=float,
        metavar="M",
        help="Strict: how far a claim may lie from the truth, m.  [default: half a disc]",
    ),
    "tolerance_s": in_scoring(
        "--tolerance tolerance_s",
        type=float,
        metavar="SECONDS",
        help="Longest time from a row of truth to its frame.  [default: half a frame]",
    ),
    "landmarks": landmarks,
    "methods": methods,
}


def _scoring(values: dict[str, Any]) -> ScoringOptions:
    from sonarrec.evaluation.match import ScoringOptions

    chosen = {key: values[key] for key in _SCORING}
    return ScoringOptions(**chosen, sonar=stated_in(values["sonar_file"]))


class _MethodRate(click.ParamType[tuple[str, float]]):
    """RATE, for every method looked at, or METHOD=RATE: (method or "", rate)."""

    name = "[METHOD=]RATE"

    def convert(self, value: Any, *context: Any) -> tuple[str, float]:
        method, _, rate = str(value).rpartition("=")
        return method, FiniteRange(0, 1).convert(rate, *context)


_LIMITS = {
    "least_tpr": in_scoring(
        "--least-tpr",
        type=_MethodRate(),
        multiple=True,
        help="Exit with 4 if the TPR over all IDs is lower.",
    ),
    "most_fpr": in_scoring(
        "--most-fpr",
        type=_MethodRate(),
        multiple=True,
        help="Exit with 4 if the FPR over all IDs is higher.",
    ),
}


def _limits(values: dict[str, Any]) -> Limits:
    from sonarrec.evaluation.compare import Limits

    least, most = (dict(values[key]) for key in ("least_tpr", "most_fpr"))
    return Limits(least_tpr=least, most_fpr=most)


# --least-tpr and --most-fpr, as one `limits`: Limits.
limits = as_one("limits", _LIMITS, _limits)

# What is scored, how, and in which geometry, as one `scoring`: ScoringOptions.
scoring = as_one("scoring", _SCORING | {"sonar_file": sonar_file}, _scoring)

# Settings

_SETTINGS = {
    "preset": in_settings(
        "--preset",
        metavar="NAME[,NAME]",
        shell_complete=names_of(_presets),
        help="default (frame by frame), offline (results are revised by what the log shows later) "
        "or paper (every rule as published). `sonarrec run` takes several.",
    ),
    "config_file": in_settings(
        "--config config_file",
        type=FILE,
        help="Settings (TOML), or the run.toml of an earlier run.",
    ),
    "assignments": in_settings(
        "--set assignments",
        multiple=True,
        metavar="STAGE.KEY=VALUE",
        shell_complete=names_of(_settings),
        help="Change one setting; repeatable. All: `sonarrec config`.",
    ),
}


@dataclass(frozen=True, slots=True)
class SettingsChoice:
    """The settings as given on the command line."""

    values: Mapping[str, Any]

    @property
    def file(self) -> Path | None:
        """The settings file, or the run.toml of an earlier run."""
        file: Path | None = self.values["config_file"]
        return file

    def configs(self) -> list[Config]:
        """A Config per preset, changed by the file, then by --set."""
        from sonarrec import config

        preset = self.values["preset"]
        chosen = config.configs(preset.split(",") if preset else [], self.file)
        return [config.with_assignments(c, self.values["assignments"]) for c in chosen]

    def config(self) -> Config:
        """The only Config. Raises UsageError if several presets are given."""
        first, *more = self.configs()
        if more:
            raise UsageError(
                "several presets are given, but this command takes one; choose it with --preset"
            )
        return first


settings = as_one("settings", _SETTINGS, SettingsChoice)

# Output

quiet = in_output(
    "-q --quiet",
    is_flag=True,
    help="No progress bar and no summary; still notes and errors.",
)


def json(text: str = "Print one JSON document on stdout.") -> Decorator:
    """--json, as `as_json`."""
    return in_output("--json as_json", is_flag=True, help=text)


def out(kind: click.Path, text: str, **options: Any) -> Decorator:
    """-o, --out. text: what it names."""
    return in_output("-o --out", type=kind, help=text, **options)
