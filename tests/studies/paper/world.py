"""Worlds: answers to all that the paper leaves open of its basin, each within a range.

What the paper leaves open is a list of unknowns, each with a range argued from its text.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.motion import sweep_deg
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, load_scene
from sonarrec.simulation.world import object_radius
from tests.studies.paper.published import FRAMES, IDS, IN_VIEW, PRESENT
from tests.studies.study import gaps

STABLE_FRAMES = 160
"""One sweep."""
KEPT = Path(__file__).with_name("worlds.toml")
APART_M = 0.05
"""Least floor between two things."""
IN_VIEW_TOLERANCE = 10
"""Frames: how near the in-view counts come to the paper's."""
FAKES = ("blank", "half_ring", "spokes", "filled")
"""What a circular fake landmark may be."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """Something the paper leaves open. why: the range's argument."""

    name: str
    low: float
    high: float
    why: str


UNKNOWNS = (
    Unknown("ring_db", 9, 16, "gel-stone reflects much, over a basin's floor"),
    Unknown("symbol_db", -2, 2, "over the ring: the same material"),
    *(
        Unknown(f"own_db_{i}", -3, 3, "the symbol of each landmark was made and lies by hand")
        for i in PRESENT
    ),
    Unknown("plate_db", -12, -5, "aluminium reflects less than the floor"),
    Unknown("object_db", 0.6, 2.2, "unstable reflection"),
    Unknown("patch_db", 0.6, 2.5, "unstable reflection, within a disc"),
    Unknown("fading_s", 2, 10, "misses come in spells: areas A and B of Figure 14"),
    Unknown("frame_probability", 0, 0.05, "frames that fade alone"),
    Unknown("burst_probability", 0, 0.03, "spells of fading frames"),
    Unknown("burst_frames", 3, 12, "their length"),
    Unknown("depth_db", 5, 12, "their depth"),
    Unknown("ghost_db", -20, -10, "residual images"),
    Unknown("snr_db", 16, 24, "speckle and noise of a DIDSON"),
    Unknown("dynamic_range_db", 40, 60, "its display's range"),
    *(Unknown(f"ground_m_{i}", 1.56, 2.20, "slant range 1.7 to 2.3 m") for i in PRESENT),
    *(Unknown(f"azimuth_deg_{i}", -32, 32, "in the pan") for i in PRESENT),
    *(Unknown(f"turn_deg_{i}", 0, 360, "told nowhere") for i in PRESENT),
    Unknown("pan_start_deg", -40, 40, "told nowhere"),
    *(Unknown(f"fake_ground_m_{i}", 1.56, 2.20, "1.7 to 2.3 m, as the landmarks") for i in (1, 2)),
    *(Unknown(f"fake_azimuth_deg_{i}", -38, 38, "in the pan") for i in (1, 2)),
    *(Unknown(f"fake_turn_deg_{i}", 0, 360, "told nowhere") for i in (1, 2)),
    Unknown("mesh_azimuth_deg", -38, 38, "wire mesh, in the pan"),
    Unknown("mesh_ground_m", 1.7, 2.5, "by the landmarks or behind them"),
    Unknown("beam_azimuth_deg", -38, 38, "wood, in the pan"),
    Unknown("beam_ground_m", 1.7, 2.5, "by the landmarks or behind them"),
)
NAMES = tuple(u.name for u in UNKNOWNS)
LOW = np.array([u.low for u in UNKNOWNS])
HIGH = np.array([u.high for u in UNKNOWNS])
PLACES = np.array([any(w in n for w in ("ground", "azimuth", "pan_start")) for n in NAMES])
FAKE, STRAY = len(IDS), -1
"""Numbers of parts, beside the indices of the landmarks into IDS."""
PARTS = {
    **{
        IDS.index(i): [n for n in NAMES if n.endswith(f"_{i}") and "fake" not in n] for i in PRESENT
    },
    FAKE: [n for n in NAMES if n.startswith("fake")],
    STRAY: [n for n in NAMES if n.startswith(("mesh", "beam"))],
}
"""Part: the unknowns that are its own. SMI says of each the same whatever the others are."""
SHARED = np.array([not any(n in names for names in PARTS.values()) for n in NAMES])


@dataclass(frozen=True, slots=True)
class World:
    """One answer to all that is unknown. fakes: kinds of the circular fakes, one or two.

    number: of those that the search built.
    """

    values: dict[str, float]
    fakes: tuple[str, ...]
    number: int = -1

    def scene(self, seed: int, frames: int = FRAMES) -> Scene:
        """The paper's scene in this world."""
        v, base = self.values, load_scene("paper")
        landmarks = tuple(
            PlacedLandmark(
                i,
                v[f"ground_m_{i}"],
                v[f"azimuth_deg_{i}"],
                v[f"turn_deg_{i}"],
                bright_db=v["ring_db"],
                symbol_db=round(v["ring_db"] + v["symbol_db"] + v[f"own_db_{i}"], 2),
                plate_db=v["plate_db"],
            )
            for i in PRESENT
        )
        fakes = [
            PlacedObject(
                kind,
                v[f"fake_ground_m_{n}"],
                v[f"fake_azimuth_deg_{n}"],
                v[f"fake_turn_deg_{n}"],
                bright_db=v["ring_db"],
                plate_db=v["plate_db"],
            )
            for n, kind in enumerate(self.fakes, 1)
        ]
        strays = [
            replace(o, ground_m=v[f"{o.kind}_ground_m"], azimuth_deg=v[f"{o.kind}_azimuth_deg"])
            if o.kind in ("mesh", "beam")
            else o
            for o in base.objects
            if o.kind in ("mesh", "beam", "wall")
        ]
        fading = replace(
            base.fading,
            time_s=v["fading_s"],
            **{
                k: v[k]
                for k in (
                    "object_db",
                    "patch_db",
                    "frame_probability",
                    "burst_probability",
                    "burst_frames",
                    "depth_db",
                    "ghost_db",
                )
            },
        )
        return replace(
            base,
            seed=seed,
            frames=frames,
            motion=replace(base.motion, pan_start_deg=v["pan_start_deg"]),
            fading=fading,
            noise=replace(base.noise, snr_db=v["snr_db"]),
            picture=replace(base.picture, dynamic_range_db=v["dynamic_range_db"]),
            landmarks=landmarks,
            objects=(*fakes, *strays),
        )

    def vector(self) -> FloatArray:
        """(n,) the unknowns, in the order of UNKNOWNS."""
        return np.array([self.values[n] for n in NAMES])


def in_view(azimuth_deg: FloatArray, pan_start_deg: FloatArray) -> FloatArray:
    """(n, 3) of how many frames places (n, 3) are within the fan's bearings; starts: (n,).

    A landmark is in view from about half a disc on: the paper's counts come to that.
    """
    scene = load_scene("paper")
    motion = scene.motion
    travelled = motion.pan_deg_s * np.arange(FRAMES) / scene.rate_hz
    pan = sweep_deg(motion.pan_min_deg, motion.pan_max_deg, pan_start_deg[:, None], travelled)
    half = scene.sonar.field_of_view_deg / 2
    return (np.abs(pan[:, None] - azimuth_deg[..., None]) <= half).sum(axis=2)


def apart(world: World) -> bool:
    """Whether nothing lies on another thing."""
    scene = world.scene(0)
    objects = [o for o in scene.objects if o.kind != "wall"]
    things: list[PlacedLandmark | PlacedObject] = [*scene.landmarks, *objects]
    radius = [scene.landmark_set.radius_m] * len(scene.landmarks)
    radius += [object_radius(scene, o) for o in objects]
    between = gaps(
        np.array([t.ground_m for t in things]),
        np.array([t.azimuth_deg for t in things]),
        np.array(radius),
    )
    return bool((between > APART_M).all())


def first_possible(values: FloatArray, fakes: tuple[str, ...]) -> World | None:
    """Of (n, unknowns) the first whose places agree with the paper's counts and each other."""
    azimuth = values[:, [NAMES.index(f"azimuth_deg_{i}") for i in PRESENT]]
    counts = in_view(azimuth, values[:, NAMES.index("pan_start_deg")])
    off = np.abs(counts - [IN_VIEW[i] for i in PRESENT]).max(axis=1)
    for row in np.flatnonzero(off <= IN_VIEW_TOLERANCE):
        world = _world(values[row], fakes)
        if apart(world):
            return world
    return None


TRIES = 1024


def drawn(rng: np.random.Generator, like: World | None = None) -> World:
    """A world from the ranges; its places are drawn until they are possible.

    like: a world whose SHARED unknowns are to be the same.
    """
    start = rng.uniform(LOW, HIGH) if like is None else like.vector()
    again = PLACES if like is None else ~SHARED
    fakes = tuple(rng.choice(FAKES, 1 + int(rng.random() < 1 / 3)).tolist())
    world = None
    while world is None:
        values = rng.uniform(LOW, HIGH, (TRIES, len(NAMES)))
        world = first_possible(np.where(again, values, start), fakes)
    return world


def _world(values: FloatArray, fakes: Iterable[str]) -> World:
    digits = [3 if u.high - u.low < 1 else 2 for u in UNKNOWNS]
    rounded = [round(float(v), d) for v, d in zip(values, digits, strict=True)]
    return World(dict(zip(NAMES, rounded, strict=True)), tuple(fakes))


def put_together(parts: Sequence[World]) -> World:
    """A world of the parts of several that share what is SHARED, in the order of PARTS."""
    values = dict(parts[0].values)
    for names, world in zip(PARTS.values(), parts, strict=True):
        values |= {n: world.values[n] for n in names}
    return World(values, parts[list(PARTS).index(FAKE)].fakes)


def stable(world: World, seed: int) -> Scene:
    """One sweep of the world while its reflections are steady."""
    scene = world.scene(seed, STABLE_FRAMES)
    steady = replace(
        scene.fading, object_db=0.0, patch_db=0.0, frame_probability=0.0, burst_probability=0.0
    )
    start = replace(scene.motion, pan_start_deg=scene.motion.pan_min_deg)
    return replace(scene, fading=steady, motion=start)


def kept_worlds(use: str) -> list[World]:
    """The worlds on record that serve for one thing: "choice" or "report"."""
    with KEPT.open("rb") as file:
        rows = tomllib.load(file)["world"]
    return [
        World({n: row[n] for n in NAMES}, tuple(row["fakes"]), row["number"])
        for row in rows
        if row["use"] == use
    ]
