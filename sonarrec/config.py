"""Every setting, once: its default, bounds, unit and meaning, and where it is in the paper.

All presets are one code path with different numbers. What the paper leaves open is marked "open in
the paper"; PRESETS has the values that `--preset paper` uses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from sonarrec.errors import SonarrecError, UsageError, as_usage
from sonarrec.tables.toml import (
    Count,
    NotNegative,
    Share,
    bounds,
    brief,
    checked,
    choices,
    from_table,
    parse_toml,
    read_toml,
    types_of,
)


def _setting(default: Any, unit: str, meaning: str) -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True, slots=True)
class Candidates:
    """Stage 1, candidate selection (Section 3.2)."""

    plane: Literal["fan", "floor"] = _setting(
        "floor",
        "",
        "image in which circles are looked for: the fan, with Eq. 1's squeezed outline, or the "
        "floor seen from above (exact where height_m is known)",
    )
    detector: Literal["edge", "ring"] = _setting(
        "ring",
        "",
        "edge: Canny edges against the outline (the paper's); ring: bright ring, darker "
        "inside and outside",
    )
    disc_radius_px: Annotated[float, bounds(3)] = _setting(
        12.0,
        "pixels",
        "of a landmark seen from above: at most that in the fan; 9 on floors of over 2^18 pixels",
    )
    threshold: Share = _setting(
        0.4,
        "0 to 1",
        "least score of a candidate. edge: share of the outline on an edge (the paper asks for "
        "all N pixels, which no recording reaches); ring: see ring_full_contrast",
    )
    ring_full_contrast: Annotated[float, bounds(0.01)] = _setting(
        1.6, "speckle sigmas", "ring: mean contrast of ring over surroundings that scores 1"
    )
    min_visible: Annotated[float, bounds(0.01, 1)] = _setting(
        0.35, "share", "least share of the ring inside the fan"
    )
    edge_gain: Literal["root", "none"] = _setting(
        "root",
        "",
        "root: scores at the fan's edge are divided by the root of the share of the ring that is "
        "inside, so that chance candidates are as frequent there as within; none: as correlated",
    )
    max_candidates: Count = _setting(
        12,
        "",
        "per frame, the best ones; where the floor in view has room for more than 300 discs, "
        "more in proportion, up to 8 times as many",
    )
    separation: NotNegative = _setting(0.35, "disc diameters", "least distance between candidates")
    canny_low: NotNegative = _setting(1.0, "frame sigmas", "edge: Canny's lower threshold")
    canny_high: NotNegative = _setting(3.0, "frame sigmas", "edge: Canny's upper threshold")


@dataclass(frozen=True, slots=True)
class Continuity:
    """Stage 2, continuity evaluation with a particle filter (Section 3.3)."""

    particles: Annotated[int, bounds(1, 30_000)] = _setting(
        250, "", "in each group; 1000 to 2000 in the paper, which does not measure motion"
    )
    sigma_px: NotNegative = _setting(
        10.0, "fan pixels", "random walk of a particle per frame, Eq. 3"
    )
    motion: Literal["random_walk", "image"] = _setting(
        "image",
        "",
        "random_walk: Eq. 3 alone, as the paper; image: the sonar's motion is measured between "
        "the frames first. Poses give it in both cases. If it is known, the walk is "
        "sigma_known_px wide",
    )
    sigma_known_px: NotNegative = _setting(
        4.0,
        "fan pixels",
        "random walk if the motion is known; image: also how wide a group begins",
    )
    z_hit: NotNegative = _setting(
        0.95, "weight", "weight of the score map in Eq. 4; open in the paper"
    )
    # If it were 0, a frame in which nothing is hit would leave no weight at all.
    z_rand: Annotated[float, bounds(1e-9)] = _setting(
        0.05, "weight", "weight of the uniform part in Eq. 4; open in the paper"
    )
    hit_power: NotNegative = _setting(
        4.0, "", "P_hit = score ** hit_power: how sharply particles gather; open in the paper"
    )
    p_hit: Literal["map", "normalised"] = _setting(
        "map",
        "",
        "Eq. 4: map: P_hit is the power of the score itself, with a P_rand of 1 / particles; "
        "normalised: it is divided by its sum over the group, so that both are probabilities of "
        "the particles; open in the paper",
    )
    spread_limit: NotNegative = _setting(
        0.25,
        "disc diameters",
        "a group wider than this in either axis, after weighting, gets a strike",
    )
    strikes: Count = _setting(5, "", "strikes that delete a group; the paper says five times")
    count_strikes: Literal["in_a_row", "in_all"] = _setting(
        "in_a_row", "", "in_a_row: a frame without a strike sets the count to 0; in_all: not"
    )
    min_existence: Share = _setting(
        0.05, "probability", "a group less likely to exist is deleted; 0 leaves it to the strikes"
    )
    least_in_view: Share = _setting(
        0.35, "share", "of the disc inside the fan; with less, a group has left the view"
    )
    remember_frames: Count = _setting(
        400,
        "frames",
        "motion known: how long a group that left the view is remembered, to keep its number",
    )
    merge: NotNegative = _setting(
        0.3, "disc diameters", "groups nearer than this are one object: the older stays"
    )
    new_group: NotNegative = _setting(
        0.3, "disc diameters", "a candidate farther than this from every group starts one"
    )


@dataclass(frozen=True, slots=True)
class Features:
    """Stage 3, Bayesian feature estimation (Section 3.4)."""

    motion_model: Literal["inverse_distance", "association"] = _setting(
        "association",
        "",
        "Eq. 5: inverse_distance mixes the beliefs of neighbours by 1 / distance ** "
        "distance_power; association carries each track's own belief on",
    )
    distance_power: NotNegative = _setting(
        1.0, "", "inverse_distance: 1 is the paper's wording taken literally; open in the paper"
    )
    new_belief: Literal["uniform", "neighbours"] = _setting(
        "uniform",
        "",
        "inverse_distance: the belief in an object that has just begun; neighbours: by Eq. 5 from "
        "the objects of the frame before; open in the paper",
    )
    measurement: Literal["single", "track"] = _setting(
        "track",
        "",
        "single: similarities in this frame, as the paper; track: the shape matrix "
        "averaged along the track, with 'none of these' among the hypotheses",
    )
    least_ring: Share = _setting(
        0.0,
        "share",
        "single: of the ring's cells that must be bright for the frame's symbol to count: the "
        "paper's outer lines, which test for the circle; open in the paper",
    )
    memory_frames: NotNegative = _setting(
        40.0, "frames", "track: memory of the averaged shape matrix"
    )
    beam_width_deg: Annotated[float, bounds(0, 5)] = _setting(
        0.0,
        "degrees",
        "track: width of the beams, two-way, between half-power points, by which they smear a "
        "landmark's symbol. 0: as the log states it, else usual for the field of view",
    )
    lag_frames: Count = _setting(
        0,
        "frames",
        "how long results wait, to be revised by what their tracks showed since",
    )
    decide: Literal["threshold", "comparison"] = _setting(
        "threshold",
        "",
        "threshold: every object whose ID has the least score is declared; comparison: also, an ID "
        "goes to the one object of a frame for which it is most probable (Section 4), and the "
        "others have score 0",
    )
    # The least, in steps of 0.10 from 0.75 on, without a false claim in thirteen recordings of
    # other worlds. On tuning seeds of hard kinds it halves false claims, for .03 of the TPR.
    declare: Share = _setting(0.85, "probability", "least score at which an ID is declared")
    # The least of .85 to .99 at which single frames of random scenes (seeds 41000 to 41013) have no
    # more false claims in 100 frames than runs: 0 over twelve kinds, .14 over 27 (runs: .11, .94).
    declare_alone: Share = _setting(
        0.98,
        "probability",
        "track: as declare, in a log of a single frame; of drawn plates none is declared there",
    )


@dataclass(frozen=True, slots=True)
class Smi:
    """The single-frame baseline, shape-matrix identification (Section 3.4.2)."""

    declare: Share = _setting(
        0.6, "0 to 1", "least similarity x bright share of the ring at which an ID is declared"
    )


@dataclass(frozen=True, slots=True)
class Config:
    """All settings of one run."""

    preset: str = "default"
    seed: Count = 0
    candidates: Candidates = field(default_factory=Candidates)
    continuity: Continuity = field(default_factory=Continuity)
    features: Features = field(default_factory=Features)
    smi: Smi = field(default_factory=Smi)


SECTIONS = {"candidates": Candidates, "continuity": Continuity, "features": Features, "smi": Smi}

GONE = (("features", "alike_radii"),)
"""Settings of earlier versions, which files of users may still have."""

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "default": {},
    "offline": {"features": {"lag_frames": 240}},
    # How the values that are open in the paper were chosen: those of candidates and smi on Table 4
    # alone; those of continuity and features in six basins in which this SMI meets Table 4, so that
    # the worse of the two errors is small as a share of SMI's. distance_power is from an earlier
    # search for what comes nearest to both Tables 4 and 5; later it was compared with 1 and 2.
    "paper": {
        "candidates": {
            "plane": "fan",
            "detector": "edge",
            "threshold": 0.65,
            "canny_low": 0.75,
            "canny_high": 2.5,
            "max_candidates": 8,
            "separation": 0.6,
        },
        "continuity": {
            "motion": "random_walk",
            "merge": 0.5,
            "new_group": 0.6,
            "particles": 1500,
            "hit_power": 8.0,
            "count_strikes": "in_all",
            "min_existence": 0.0,
            "least_in_view": 0.5,
        },
        "features": {
            "motion_model": "inverse_distance",
            "distance_power": 6.0,
            "measurement": "single",
            "least_ring": 0.6,
            "decide": "comparison",
            "declare": 0.29,
        },
        "smi": {"declare": 0.5},
    },
}


def preset(name: str) -> Config:
    """The settings of a preset.

    Parameters
    ----------
    name : {"default", "offline", "paper"}
        The preset.

    Returns
    -------
    Config
        Settings by stage; `dataclasses.replace` changes them. Units are those of
        `sonarrec config`.

    Raises
    ------
    UsageError
        There is no preset of that name.
    """
    if name not in PRESETS:
        raise UsageError(f"unknown preset {brief(name)}; there are: {', '.join(PRESETS)}")
    return with_table(Config(preset=name), PRESETS[name], f"preset {name}")


def with_table(config: Config, table: Mapping[str, Any], where: str) -> Config:
    """`config`, changed by the keys of a table of sections. where: names the table in errors.

    Raises UsageError for an unknown section or key, and for an invalid value.
    """
    stated = {key: value for key, value in table.items() if key != "preset"}
    return _over(config, stated, where)


def _over(config: Config, table: Mapping[str, Any], where: str) -> Config:
    for section, key in GONE:
        if isinstance(keys := table.get(section), dict) and key in keys:
            raise UsageError(
                f"{where}: {section}.{key} has no effect since stage 3 reads symbols by a network; "
                "delete it"
            )
    with as_usage():
        return from_table(Config, table, where, over=config)


def configs(presets: Sequence[str] = (), path: Path | None = None) -> list[Config]:
    """The configurations of several presets, changed by the settings of a TOML file.

    path: a file of settings, or a run.toml. If no preset is given, the file's own is used.
    Raises UsageError if the file cannot be read or holds anything but settings, and for a preset
    that is unknown or given twice.
    """
    tables = [{}] if path is None else _config_tables(path)
    if not presets:
        presets = [table.get("preset", "default") for table in tables]
    presets = [name.strip() for name in presets]  # they are typed as a list
    if len(set(presets)) < len(presets):
        raise UsageError(f"--preset {','.join(presets)}: name each preset once")
    chosen = []
    for name in presets:
        same = [t for t in tables if t.get("preset", name) == name]
        # Settings of a single preset apply to any preset, those of several each to its own.
        table = same[0] if same else tables[0] if len(tables) == 1 else {}
        chosen.append(with_table(preset(name), table, str(path)))
    return chosen


def _config_tables(path: Path) -> list[dict[str, Any]]:
    with as_usage():
        table = read_toml(path)
        tables = table.get("config", table)  # a run.toml keeps the settings under [config]
        if not isinstance(tables, list):
            tables = [tables]
        if not tables or not all(isinstance(t, dict) for t in tables):
            raise SonarrecError(f"{path}: config must be a table of settings")
        for table in tables:
            checked(table.get("preset", ""), str, f"{path}: preset")
    return tables


def with_assignments(config: Config, assignments: Sequence[str]) -> Config:
    """`config`, changed by texts such as `stage.key=value` and `seed=3`. Raises UsageError for an
    invalid one."""
    for text in assignments:
        name, equals, value = (part.strip() for part in text.partition("="))
        section, dot, key = name.partition(".")
        if not equals or not (dot or name == "seed"):
            raise UsageError(
                f"--set {brief(text)}: expected stage.key=value, as `sonarrec config` lists"
            )
        try:
            parsed = parse_toml(f"value = {value}", "--set")["value"]
        except SonarrecError:
            parsed = _plain(value)
        table = {section: {key: parsed}} if dot else {name: parsed}
        config = _over(config, table, "--set")
    return config


def _plain(value: str) -> float | str:
    """The value of a text that is not TOML: a number such as .5, or a name without quotes."""
    try:
        return float(value)
    except ValueError:
        return value


def as_commented_toml(config: Config) -> str:
    """The configuration as TOML with units and meanings as comments: `sonarrec config`."""
    lines = [f'preset = "{config.preset}"', f"seed = {config.seed}"]
    for name, kind in SECTIONS.items():
        lines += ["", f"# {(kind.__doc__ or '').splitlines()[0]}", f"[{name}]"]
        for setting in fields(kind):
            value = getattr(getattr(config, name), setting.name)
            words = " | ".join(choices(types_of(kind)[setting.name]))
            unit = setting.metadata["unit"]
            lines.append(
                f"# {setting.metadata['meaning']}{unit and f' [{unit}]'}{words and f' ({words})'}"
            )
            lines.append(f"{setting.name} = {value!r}".replace("'", '"'))
    return "\n".join(lines) + "\n"
