"""The worlds on record: answers to all that the paper leaves open of its basin, within ranges.

search.py draws them, measures them against Tables 3 and 4, and keeps those that meet these. Nothing
was chosen in them: prediction.py says how `--preset paper` was.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, load_scene
from tests.studies.paper.published import FRAMES, PRESENT

KEPT = Path(__file__).with_name("worlds.toml")
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
    *(Unknown(f"own_db_{i}", -3, 3, "each symbol was made and lies by hand") for i in PRESENT),
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
FADING = (
    *("object_db", "patch_db", "frame_probability", "burst_probability", "burst_frames"),
    *("depth_db", "ghost_db"),
)


@dataclass(frozen=True, slots=True)
class World:
    """One answer to all that is unknown. fakes: kinds of the circular fakes, one or two.

    number: of those that were built.
    """

    values: dict[str, float]
    fakes: tuple[str, ...]
    number: int = -1

    def scene(self, seed: int, frames: int = FRAMES) -> Scene:
        """The paper's scene in this world."""
        v, base = self.values, load_scene("paper")
        lies = ("ground_m", "azimuth_deg", "turn_deg")
        levels = {"bright_db": v["ring_db"], "plate_db": v["plate_db"]}
        landmarks = []
        for i in PRESENT:
            symbol_db = round(v["ring_db"] + v["symbol_db"] + v[f"own_db_{i}"], 2)
            place = (v[f"{name}_{i}"] for name in lies)
            landmarks.append(PlacedLandmark(i, *place, symbol_db=symbol_db, **levels))
        fakes = [
            PlacedObject(kind, *(v[f"fake_{name}_{n}"] for name in lies), **levels)
            for n, kind in enumerate(self.fakes, 1)
        ]
        strays = [
            replace(o, ground_m=v[f"{o.kind}_ground_m"], azimuth_deg=v[f"{o.kind}_azimuth_deg"])
            if o.kind in ("mesh", "beam")
            else o
            for o in base.objects
            if o.kind in ("mesh", "beam", "wall")
        ]
        fading = replace(base.fading, time_s=v["fading_s"], **{k: v[k] for k in FADING})
        motion = replace(base.motion, pan_start_deg=v["pan_start_deg"])
        noise = replace(base.noise, snr_db=v["snr_db"])
        picture = replace(base.picture, dynamic_range_db=v["dynamic_range_db"])
        seen = {"motion": motion, "fading": fading, "noise": noise, "picture": picture}
        things = {"landmarks": tuple(landmarks), "objects": (*fakes, *strays)}
        return replace(base, seed=seed, frames=frames, **seen, **things)


def kept_worlds() -> list[World]:
    """The worlds on record."""
    with KEPT.open("rb") as file:
        rows = tomllib.load(file)["world"]
    return [World({n: row[n] for n in NAMES}, tuple(row["fakes"]), row["number"]) for row in rows]
