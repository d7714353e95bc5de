"""Scenes: the world, the sonar and its faults that the simulator renders, as data.

A scene is a readable TOML file, or built in Python with dataclasses.replace.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sonarrec.geometry import fan_for_image, fan_for_polar
from sonarrec.landmarks import LandmarkSet, landmarks_from_table, load_landmarks
from sonarrec.records import Fan, FloatArray, SonarrecError, UsageError
from sonarrec.sonar import Sonar, check_sonar

BUILT_IN = Path(__file__).parent / "scenes"

# What can lie on the floor besides landmarks.
# kind: (size, width, height above the floor, all m; brightness, dB above the floor)
# size: the radius of round things (for discs 0 = the landmark set's radius), the length of long
# ones, one side of a patch. width: of long things and of the other side of a patch.
KINDS: dict[str, tuple[float, float, float, float]] = {
    "blank": (0.0, 0.0, 0.0, 12.0),  # a landmark's ring and plate without a symbol
    "filled": (0.0, 0.0, 0.0, 11.0),  # bright all over
    "spokes": (0.0, 0.0, 0.0, 11.0),  # ring with four thin spokes
    "half_ring": (0.0, 0.0, 0.0, 11.0),  # half of a blank disc's ring
    "tyre": (0.11, 0.0, 0.03, 9.0),  # a thick bright torus, no plate inside
    "mesh": (0.40, 0.45, 0.0, 11.0),  # a patch of wire netting
    "beam": (0.70, 0.06, 0.03, 8.0),  # a wooden beam
    "stone": (0.05, 0.0, 0.03, 8.0),
    "cover": (0.15, 0.0, 0.0, 0.0),  # sediment that hides what lies below
    "wall": (8.0, 0.15, 1.5, 11.0),
}
ROUND = ("blank", "filled", "spokes", "half_ring", "tyre", "stone", "cover")


@dataclass(frozen=True, slots=True)
class SonarSection:
    """The imaging sonar; the defaults are a DIDSON's. The axis stands at the floor's origin."""

    layout: str = "fan"  # what is written: "fan" or "polar"
    range_min_m: float = 1.25
    range_max_m: float = 3.75
    range_bins: int = 512  # also the rows of the image
    beams: int = 96
    field_of_view_deg: float = 28.8
    bearings: str = "even"  # "didson": beams 0.22 to 0.37 deg apart, closest at the edges
    height_m: float = 0.68  # true height above the floor
    tilt_deg: float = 20.0  # true tilt, downward
    height_error_m: float = 0.0  # what sonar.toml says, less the truth
    tilt_error_deg: float = 0.0  # what sonar.toml says, less the truth
    vertical_beam_deg: float = 14.0  # two-way, between half-power points
    beam_width_deg: float = 0.4  # two-way, between half-power points
    side_lobe_db: float = -30.0  # of each beam, two-way, below its main lobe
    stray_db: float = -38.0  # leak between beams eight apart, which fire together
    cross_talk_db: float = -38.0  # leak of every beam into every other
    pulse_m: float = 0.008  # length of the pulse in range, between half-power points


@dataclass(frozen=True, slots=True)
class MotionSection:
    """How the sonar moves: a triangular pan sweep, and what disturbs it."""

    pan_min_deg: float = -40.0
    pan_max_deg: float = 40.0
    pan_start_deg: float = -40.0  # at the first frame, moving to the right
    pan_deg_s: float = 2.0
    yaw_jitter_deg: float = 0.0  # standard deviation, around the sweep
    yaw_jitter_s: float = 0.5  # correlation time
    heave_m: float = 0.0  # amplitude
    heave_period_s: float = 7.0
    sway_x_m: float = 0.0  # amplitude of slow translation to the right
    sway_y_m: float = 0.0  # and forward
    sway_period_s: float = 60.0


@dataclass(frozen=True, slots=True)
class FloorSection:
    """The floor, whose mean brightness on the beam's axis is 0 dB."""

    texture_db: float = 1.2  # standard deviation of its slow changes
    texture_m: float = 0.15  # their size
    angle_exponent: float = 1.0  # backscattered power goes with sin(grazing angle) to this power
    speckle_s: float = 120.0  # time after which speckle has changed (correlation 1/e)
    speckle_m: float = 0.12  # sway or heave after which speckle has changed (correlation 1/e)


@dataclass(frozen=True, slots=True)
class FadingSection:
    """Unstable reflection, and its cousins."""

    object_db: float = 1.2  # standard deviation of each object's brightness
    patch_db: float = 1.5  # and of the patches of an object
    patch_m: float = 0.06  # size of the patches
    time_s: float = 6.0  # correlation time of both
    specular_db: float = 2.5  # how much brighter ring edges that face the sonar are
    frame_probability: float = 0.01  # of a frame that fades alone
    burst_probability: float = 0.0  # of a burst of fading frames to begin
    burst_frames: float = 6.0  # mean length of a burst
    depth_db: float = 8.0  # mean loss of a fading frame
    ghost_db: float = -16.0  # an object's blurred afterglow, below its own brightness
    ghost_shift_m: float = 0.10  # in range
    ghost_blur_m: float = 0.05  # standard deviation in range


@dataclass(frozen=True, slots=True)
class NoiseSection:
    """The receiver and its gains."""

    snr_db: float = 22.0  # of the floor on the beam's axis, above thermal noise
    smear: float = 0.2  # share of the power that the receiver spreads over neighbours, 0 to 1
    shadow_db: float = -16.0  # multipath in acoustic shadows, relative to the floor
    gain_drift_db: float = 0.0  # amplitude over the log
    gain_drift_s: float = 150.0  # period
    group_gain_db: float = 0.6  # standard deviation of the steps between groups of 8 beams
    beam_gain_db: float = 0.3  # and from beam to beam
    hot_beams: int = 2  # beams with too much gain
    hot_beam_db: float = 2.0


@dataclass(frozen=True, slots=True)
class PictureSection:
    """Log compression to 8 bit."""

    black_db: float = -17.0  # power shown as 0, relative to the floor
    dynamic_range_db: float = 50.0  # from 0 to 255
    gamma: float = 1.0


@dataclass(frozen=True, slots=True)
class PlacedLandmark:
    """A landmark of the scene's set on the floor.

    ground_m, azimuth_deg: of its centre along the floor from below the sonar's axis; azimuth
    positive to the right of pan 0. orientation_deg: where the first sector begins,
    counter-clockwise seen from above, from the right of a sonar at pan 0.
    """

    id: int
    ground_m: float
    azimuth_deg: float
    orientation_deg: float = 0.0
    bright_db: float = 12.0
    symbol_db: float = 11.0
    plate_db: float = -7.0


@dataclass(frozen=True, slots=True)
class PlacedObject:
    """Something else on the floor, placed like a landmark. None: as usual for its kind."""

    kind: str
    ground_m: float
    azimuth_deg: float
    orientation_deg: float = 0.0
    size_m: float | None = None
    width_m: float | None = None
    bright_db: float | None = None
    plate_db: float = -7.0


@dataclass(frozen=True, slots=True)
class Scene:
    """All that the simulator needs; the same scene and version give the same bytes."""

    name: str = "scene"
    seed: int = 1
    frames: int = 160
    rate_hz: float = 4.0
    landmark_set: LandmarkSet = field(default_factory=lambda: load_landmarks("basin"))
    sonar: SonarSection = SonarSection()
    motion: MotionSection = MotionSection()
    floor: FloorSection = FloorSection()
    fading: FadingSection = FadingSection()
    noise: NoiseSection = NoiseSection()
    picture: PictureSection = PictureSection()
    landmarks: tuple[PlacedLandmark, ...] = ()
    objects: tuple[PlacedObject, ...] = ()


_SECTIONS: dict[str, type] = {
    "sonar": SonarSection,
    "motion": MotionSection,
    "floor": FloorSection,
    "fading": FadingSection,
    "noise": NoiseSection,
    "picture": PictureSection,
}
_MAY_BE_NEGATIVE = frozenset(
    {
        "pan_min_deg",
        "pan_max_deg",
        "pan_start_deg",
        "height_error_m",
        "tilt_error_deg",
        "side_lobe_db",
        "stray_db",
        "cross_talk_db",
        "ghost_db",
        "ghost_shift_m",
        "snr_db",
        "shadow_db",
        "black_db",
        "azimuth_deg",
        "orientation_deg",
        "bright_db",
        "symbol_db",
        "plate_db",
        "hot_beam_db",
    }
)
_MAY_BE_ZERO = frozenset(
    {
        "seed",
        "range_min_m",
        "pan_deg_s",
        "yaw_jitter_deg",
        "heave_m",
        "sway_x_m",
        "sway_y_m",
        "texture_db",
        "angle_exponent",
        "object_db",
        "patch_db",
        "specular_db",
        "frame_probability",
        "burst_probability",
        "depth_db",
        "ghost_blur_m",
        "gain_drift_db",
        "group_gain_db",
        "beam_gain_db",
        "smear",
        "hot_beams",
    }
)

T = TypeVar("T")


def _build(kind: type[T], table: object, where: str) -> T:
    """A flat dataclass from a TOML table; SonarrecError names `where`, the key and the remedy."""
    if not isinstance(table, Mapping):
        raise SonarrecError(f"{where}: expected a table of keys, not {table!r}")
    types = {f.name: str(f.type) for f in fields(kind)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in types:
            raise SonarrecError(f"{where}: unknown key {key!r}; known keys: {', '.join(types)}")
        wanted = types[key].removesuffix(" | None")
        if wanted == "str":
            good = isinstance(value, str)
        else:
            allowed = (int,) if wanted == "int" else (int, float)
            good = isinstance(value, allowed) and not isinstance(value, bool)
            if good and not math.isfinite(value):
                good = False
        if not good:
            noun = {"str": "a text", "int": "a whole number", "float": "a finite number"}[wanted]
            raise SonarrecError(f"{where}: {key} must be {noun}, not {value!r}")
        if wanted != "str" and key not in _MAY_BE_NEGATIVE:
            least = 0 if key in _MAY_BE_ZERO else math.ulp(0)
            if value < least:
                bound = "0 or more" if least == 0 else "above 0"
                raise SonarrecError(f"{where}: {key} must be {bound}, not {value!r}")
        values[key] = float(value) if wanted == "float" else value
    try:
        return kind(**values)
    except TypeError:
        needed = "kind" if kind is PlacedObject else "id"
        raise SonarrecError(f"{where}: needs at least {needed}, ground_m and azimuth_deg") from None


def scene_from_table(table: Mapping[str, Any], where: str) -> Scene:
    """A Scene from the keys of its TOML; `where` names it in errors (SonarrecError)."""
    simple = {"name": "str", "seed": "int", "frames": "int", "rate_hz": "float"}
    known = [*simple, "landmark_set", *_SECTIONS, "landmark", "object"]
    for key in table:
        if key not in known:
            raise SonarrecError(f"{where}: unknown key {key!r}; known keys: {', '.join(known)}")
    values: dict[str, Any] = {}
    for key, section in _SECTIONS.items():
        values[key] = _build(section, table.get(key, {}), f"{where}, [{key}]")
    listed = table.get("landmark_set", "basin")
    if isinstance(listed, str):
        values["landmark_set"] = load_landmarks(listed)
    else:
        values["landmark_set"] = landmarks_from_table(listed, f"{where}, [landmark_set]")
    for key, name, placed in (
        ("landmark", "landmarks", PlacedLandmark),
        ("object", "objects", PlacedObject),
    ):
        rows = table.get(key, [])
        if not isinstance(rows, list):
            raise SonarrecError(f"{where}: write each {key} under its own [[{key}]]")
        values[name] = tuple(
            _build(placed, row, f"{where}, [[{key}]] {n + 1}") for n, row in enumerate(rows)
        )
    plain = {key: table[key] for key in simple if key in table}
    head = _build(_Head, plain, where)
    scene = Scene(**asdict(head), **values)
    check_scene(scene, where)
    return scene


@dataclass(frozen=True, slots=True)
class _Head:
    name: str = "scene"
    seed: int = 1
    frames: int = 160
    rate_hz: float = 4.0


def check_scene(scene: Scene, where: str) -> None:
    """Raise SonarrecError where the scene contradicts itself."""
    sonar, motion = scene.sonar, scene.motion
    if sonar.layout not in ("fan", "polar"):
        raise SonarrecError(f'{where}: layout must be "fan" or "polar", not {sonar.layout!r}')
    if sonar.bearings not in ("even", "didson"):
        raise SonarrecError(f'{where}: bearings must be "even" or "didson"')
    check_sonar(scene_sonar(scene), where)
    if sonar.beams < 16 or sonar.range_bins < 16:
        raise SonarrecError(f"{where}: beams and range_bins must be 16 or more")
    if sonar.height_m + motion.heave_m >= sonar.range_max_m or motion.heave_m >= sonar.height_m:
        raise SonarrecError(f"{where}: heave_m leaves no floor in the range window")
    if not motion.pan_min_deg <= motion.pan_start_deg <= motion.pan_max_deg:
        raise SonarrecError(f"{where}: pan_start_deg must lie between pan_min_deg and pan_max_deg")
    if motion.pan_max_deg - motion.pan_min_deg > 300:
        raise SonarrecError(f"{where}: the pan sweep must be 300 deg or less")
    for key, share in (
        ("smear", scene.noise.smear),
        ("frame_probability", scene.fading.frame_probability),
        ("burst_probability", scene.fading.burst_probability),
    ):
        if share > 1:
            raise SonarrecError(f"{where}: {key} must be 1 or less, not {share:g}")
    for landmark in scene.landmarks:
        if landmark.id not in scene.landmark_set.ids:
            raise SonarrecError(
                f"{where}: landmark id {landmark.id} is not in the set "
                f"{scene.landmark_set.name!r} ({', '.join(map(str, scene.landmark_set.ids))})"
            )
    for thing in scene.objects:
        if thing.kind not in KINDS:
            raise SonarrecError(
                f"{where}: unknown kind of object {thing.kind!r}; known: {', '.join(KINDS)}"
            )


def load_scene(source: str | Path) -> Scene:
    """Read a scene: the name of a built-in one ("paper", "basin", ...) or a TOML file.

    Raises SonarrecError where the file is missing or what it says cannot be a scene.
    """
    path = BUILT_IN / f"{source}.toml"
    if not path.is_file():
        path = Path(source)
    if not path.is_file():
        built_in = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.toml")))
        raise UsageError(f"no scene {str(source)!r}: neither a file nor built in ({built_in})")
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SonarrecError(f"{path}: not a readable TOML file ({error})") from None
    return scene_from_table(document, str(path))


def scene_table(scene: Scene) -> dict[str, Any]:
    """The scene as plain TOML values, as load_scene reads them."""
    table: dict[str, Any] = {
        "name": scene.name,
        "seed": scene.seed,
        "frames": scene.frames,
        "rate_hz": scene.rate_hz,
        "landmark_set": scene.landmark_set.as_table(),
    }
    for key in _SECTIONS:
        table[key] = asdict(getattr(scene, key))
    for key, rows in (("landmark", scene.landmarks), ("object", scene.objects)):
        table[key] = [
            {name: value for name, value in asdict(row).items() if value is not None}
            for row in rows
        ]
    return table


def vertical_beam_db(sonar: SonarSection, height_m: float, range_m: FloatArray) -> FloatArray:
    """Power (dB, at most 0) of a two-way Gaussian beam where it meets the floor.

    range_m: slant ranges. Relative to the axis at the true tilt.
    """
    sine = np.minimum(height_m / np.maximum(range_m, 1e-6), 1.0)
    off_axis = (np.degrees(np.arcsin(sine)) - sonar.tilt_deg) / sonar.vertical_beam_deg
    return np.asarray(-40 * math.log10(2) * off_axis**2)


def scene_bearings(scene: Scene) -> FloatArray:
    """(beams,) bearing of every beam's centre in degrees, left to right."""
    beams = scene.sonar.beams
    place = (np.arange(beams) + 0.5) / beams * 2 - 1
    if scene.sonar.bearings == "didson":
        # Spacing proportional to 0.37 deg in the middle, falling to 0.22 deg at both edges.
        place = (0.37 * place - 0.075 * place * np.abs(place)) / (0.37 - 0.075)
    return np.asarray(place * scene.sonar.field_of_view_deg / 2)


def scene_sonar(scene: Scene) -> Sonar:
    """The geometry as the scene's sonar.toml states it, its errors included."""
    sonar = scene.sonar
    polar = sonar.layout == "polar"
    return Sonar(
        layout="polar" if polar else "fan",
        range_min_m=sonar.range_min_m,
        range_max_m=sonar.range_max_m,
        field_of_view_deg=sonar.field_of_view_deg,
        tilt_deg=sonar.tilt_deg + sonar.tilt_error_deg,
        height_m=sonar.height_m + sonar.height_error_m,
        frame_rate_hz=scene.rate_hz,
        bearings_deg=(
            tuple(np.round(scene_bearings(scene), 4).tolist())
            if polar and sonar.bearings != "even"
            else None
        ),
    )


def scene_fan(scene: Scene) -> Fan:
    """The fan of the scene's images: for a polar layout the one its reader resamples them into."""
    sonar = scene_sonar(scene)
    if scene.sonar.layout == "polar":
        return fan_for_polar(sonar, scene.sonar.range_bins)
    scale = (scene.sonar.range_max_m - scene.sonar.range_min_m) / scene.sonar.range_bins
    half_width = scene.sonar.range_max_m * math.sin(math.radians(scene.sonar.field_of_view_deg / 2))
    return fan_for_image(sonar, scene.sonar.range_bins, 2 * math.floor(half_width / scale) + 1)
