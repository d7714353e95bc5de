"""Scenes: descriptions of the world, the sonar and its faults, which the simulator renders.

A scene is a readable TOML file, or built in Python with dataclasses.replace.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import SonarrecError, UsageError, as_usage
from sonarrec.landmarks import DrawnSet, LandmarkSet, landmarks_from_table, load_landmarks
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import fan_for_image, fan_for_polar
from sonarrec.sonar.stated import Sonar
from sonarrec.tables.toml import (
    AtLeastOne,
    Count,
    Finite,
    Integer,
    NotNegative,
    Positive,
    Share,
    bounds,
    brief,
    from_table,
    named_file,
    read_toml,
)

BUILT_IN = Path(__file__).parent / "scenes"
NO_ECHO_DB = -60.0  # multipath of this level or less is left out

# Decibels: brightness and gains; standard deviations, amplitudes and losses.
Level = Annotated[float, bounds(-200, 200)]
Spread = Annotated[float, bounds(0, 100)]
Period = Annotated[float, bounds(1e-3, 1e12)]
Size = Annotated[int, bounds(16, 2**14)]
Lean = Annotated[float, bounds(0, 45)]

# Rings with a symbol that no ID has. The built-in model learns from wedges of any width and patches
# of any shape; never from wedges of 45 degrees, three, five or six sectors, bars, crosses, letters.
LEARNED_SYMBOLS = ("wedges", "blobs")
OTHER_SYMBOLS = ("eighths", "foreign", "bar", "cross", "letter")
SYMBOLS = (*LEARNED_SYMBOLS, *OTHER_SYMBOLS)

# What can lie on the floor besides landmarks: kind: (size, width, height, bright_db).
# size: radius of round things (0: that of the landmark set), length of long ones, one side of a
# patch, m. width: of long things, or the other side of a patch, m; 0: as size. height: above the
# floor, m. bright_db: above the floor.
KINDS: dict[str, tuple[float, float, float, float]] = {
    "blank": (0.0, 0.0, 0.0, 12.0),  # a landmark's ring and plate without a symbol
    "filled": (0.0, 0.0, 0.0, 11.0),  # bright all over
    "spokes": (0.0, 0.0, 0.0, 11.0),  # ring with four thin spokes
    "half_ring": (0.0, 0.0, 0.0, 11.0),  # half of a blank disc's ring
    "tyre": (0.11, 0.0, 0.03, 9.0),  # a thick bright torus, no plate inside
    "mesh": (0.40, 0.45, 0.0, 11.0),  # a patch of wire netting
    "beam": (0.70, 0.06, 0.03, 8.0),  # a wooden beam
    "stone": (0.05, 0.0, 0.03, 8.0),
    **dict.fromkeys(SYMBOLS, (0.0, 0.0, 0.0, 11.0)),
    "cover": (0.15, 0.0, 0.0, 0.0),  # sediment that hides what lies below
    "wall": (8.0, 0.15, 1.5, 11.0),
}
ROUND = ("blank", "filled", "spokes", "half_ring", "tyre", "stone", "cover", *SYMBOLS)


@dataclass(frozen=True, slots=True)
class SonarSection:
    """The imaging sonar, above the floor's origin; the defaults are a DIDSON's."""

    layout: Literal["fan", "polar"] = "fan"
    """Of the images written."""
    range_min_m: NotNegative = 1.25
    range_max_m: Annotated[float, bounds(0.01, 1e6)] = 3.75
    range_bins: Size = 512
    """Also the rows of the image."""
    beams: Size = 96
    field_of_view_deg: Positive = 28.8
    bearings: Literal["even", "didson"] = "even"
    """didson: a beam every 0.37 deg, 0.22 at the edges."""
    height_m: Positive = 0.68
    """True height above the floor straight below."""
    tilt_deg: Positive = 20.0
    """True tilt, downward."""
    height_error_m: Finite = 0.0
    """sonar.toml states the true value plus this."""
    tilt_error_deg: Finite = 0.0
    """sonar.toml states the true value plus this."""
    vertical_beam_deg: Positive = 14.0
    """Two-way, between half-power points."""
    beam_width_deg: Positive = 0.4
    """Two-way, between half-power points."""
    side_lobe_db: Level = -30.0
    """Of each beam, two-way, below its main lobe."""
    stray_db: Level = -38.0
    """Leak between beams at distances of 8, which fire together."""
    cross_talk_db: Level = -38.0
    """Leak of every beam into every other."""
    pulse_m: Positive = 0.008
    """Length of the pulse in range, between half-power points."""


@dataclass(frozen=True, slots=True)
class MotionSection:
    """How the sonar moves: a pan sweep to and fro, a vehicle's run, and disturbances of both.

    The vehicle starts above the floor's origin; the sweep is about its heading. Each of its speeds,
    along and across the heading, is a constant plus a sine (the swing) with a phase of its own.
    """

    pan_min_deg: Finite = -40.0
    pan_max_deg: Finite = 40.0
    pan_start_deg: Finite = -40.0
    """At the first frame, moving to the right."""
    pan_deg_s: NotNegative = 2.0
    yaw_jitter_deg: NotNegative = 0.0
    """Standard deviation, around the sweep."""
    yaw_jitter_s: Positive = 0.5
    """Correlation time."""
    heave_m: NotNegative = 0.0
    """Amplitude."""
    heave_period_s: Period = 7.0
    sway_x_m: NotNegative = 0.0
    """Amplitude of slow translation to the right."""
    sway_y_m: NotNegative = 0.0
    """Amplitude of slow translation forward."""
    sway_period_s: Period = 60.0
    surge_m_s: Finite = 0.0
    """Speed ahead, the constant part."""
    surge_swing_m_s: NotNegative = 0.0
    """Amplitude of its sine."""
    crab_m_s: Finite = 0.0
    """Speed to the right, the constant part."""
    crab_swing_m_s: NotNegative = 0.0
    yaw_deg_s: Finite = 0.0
    """Turn to the right, the constant part."""
    yaw_swing_deg_s: NotNegative = 0.0
    swing_period_s: Period = 30.0
    pitch_deg: Lean = 0.0
    """Amplitude of slow changes of the tilt, which nobody states."""
    roll_deg: Lean = 0.0
    """Amplitude, about the heading."""
    attitude_period_s: Period = 6.0

    @property
    def speeds(self) -> FloatArray:
        """(2, 3) constant parts and amplitudes of the sines of the speed ahead, to the right, and
        of turning; all 0 if the sonar is on no vehicle."""
        swings = self.surge_swing_m_s, self.crab_swing_m_s, self.yaw_swing_deg_s
        return np.array([(self.surge_m_s, self.crab_m_s, self.yaw_deg_s), swings])


@dataclass(frozen=True, slots=True)
class FloorSection:
    """The floor. Its mean brightness on the beam's axis is 0 dB."""

    texture_db: Spread = 1.2
    """Standard deviation of its slow changes."""
    texture_m: Positive = 0.15
    """Their size."""
    angle_exponent: NotNegative = 1.0
    """Backscattered power: sin(grazing angle) to this power."""
    speckle_s: Positive = 120.0
    """Time after which speckle has changed (correlation 1/e)."""
    speckle_m: Positive = 0.12
    """Sway or heave after which speckle has changed (correlation 1/e)."""
    coherence: Share = 1.0
    """Share of the received power that is coherent: 1 is full speckle and noise, 0 is neither."""
    relief_m: NotNegative = 0.0
    """Standard deviation of its height: lit slopes and shadows."""
    relief_size_m: Positive = 0.03
    """Size of its bumps, and of those of things with a relief."""
    light_db: Spread = 0.0
    """By how much patches of the scene are darker, with the things on them."""
    light_m: Positive = 0.4
    """Their size; their edges are sharp."""
    debris_db: Spread = 0.0
    """By how much twigs and weed are brighter, also on top of things."""
    debris_m: Positive = 0.2
    """How far one winds before it turns."""
    slope_deg: Annotated[float, bounds(0, 30)] = 0.0
    """Of the floor, which is a plane."""
    slope_towards_deg: Finite = 0.0
    """Azimuth in which it rises."""
    ripple_height_m: NotNegative = 0.0
    """Of sand ripples, trough to crest: lit fronts, shaded backs."""
    ripple_length_m: Positive = 0.15
    """From crest to crest."""
    ripple_towards_deg: Finite = 0.0
    """Azimuth across the crests."""
    ripple_bends: Share = 0.3
    """How far crests stray from straight lines, in wavelengths."""
    silt_m: Positive = 0.08
    """Size of the patches of silt on things that have some."""
    glitter_db: Spread = 0.0
    """By how much, on average, single stones of bright parts are brighter."""
    glitter_m: Positive = 0.015
    """Size of such a stone."""
    glitter_share: Annotated[float, bounds(0.001, 0.5)] = 0.1
    """Of the bright parts' area."""


@dataclass(frozen=True, slots=True)
class FadingSection:
    """Unstable reflection: objects, patches and whole frames fade; objects have an afterglow."""

    object_db: Spread = 1.2
    """Standard deviation of each object's brightness."""
    patch_db: Spread = 1.5
    """Standard deviation of the patches of an object."""
    patch_m: Positive = 0.06
    """Size of the patches."""
    time_s: Positive = 6.0
    """Correlation time of both."""
    specular_db: Spread = 2.5
    """How much brighter ring edges that face the sonar are."""
    frame_probability: Share = 0.01
    """Of a frame that fades alone."""
    burst_probability: Share = 0.0
    """Of a burst of fading frames to begin."""
    burst_frames: Annotated[float, bounds(0, 1e9)] = 6.0
    """Mean, without its first; at least 1."""
    depth_db: Spread = 8.0
    """Mean loss of a fading frame."""
    ghost_db: Level = -16.0
    """An object's blurred afterglow, below its own brightness."""
    ghost_shift_m: Finite = 0.10
    """In range."""
    ghost_blur_m: NotNegative = 0.05
    """Standard deviation in range."""


@dataclass(frozen=True, slots=True)
class MultipathSection:
    """Echoes by way of the surface. It moves, so their speckle is new in every frame."""

    copy_db: Level = -100.0
    """Of a later, blurred copy of the scene; none at NO_ECHO_DB or less."""
    delay_m: Positive = 0.4
    """How much farther it shows."""
    blur_m: NotNegative = 0.03
    """Standard deviation in range."""
    blur_beams: NotNegative = 1.5
    """Standard deviation across."""
    band_db: Level = -100.0
    """Of a band of surface echo, over the floor; none at NO_ECHO_DB or less."""
    band_m: Positive = 2.2
    """Its range; further ones, each 3 dB weaker, follow at band_step_m."""
    band_step_m: Positive = 0.7
    band_width_m: Positive = 0.05
    """Standard deviation."""
    drift_m: NotNegative = 0.0
    """Amplitude of slow changes of delay and bands."""
    drift_s: Period = 8.0
    """Period."""


@dataclass(frozen=True, slots=True)
class FishSection:
    """Fish that swim over the floor, single or in schools; they give echoes and cast shadows."""

    number: Annotated[int, bounds(0, 500)] = 0
    """Over all the floor that the sonar may see."""
    schools: Annotated[int, bounds(0, 500)] = 0
    """Among which the schooling share is divided."""
    schooling: Share = 0.5
    length_m: Positive = 0.1
    """Of a fish, in the mean; a quarter as wide."""
    bright_db: Level = 14.0
    """Above the floor."""
    height_m: NotNegative = 0.15
    """Above the floor, at most."""
    speed_m_s: NotNegative = 0.2
    """In the mean."""


@dataclass(frozen=True, slots=True)
class NoiseSection:
    """The receiver and its gains."""

    snr_db: Level = 22.0
    """Of the floor on the beam's axis, above thermal noise."""
    smear: Share = 0.2
    """Share of the power that the receiver spreads over neighbours, 0 to 1."""
    shadow_db: Level = -16.0
    """Multipath in acoustic shadows, relative to the floor."""
    gain_drift_db: Spread = 0.0
    """Amplitude over the log."""
    gain_drift_s: Period = 150.0
    """Period."""
    group_gain_db: Spread = 0.6
    """Standard deviation of the steps between groups of 8 beams."""
    beam_gain_db: Spread = 0.3
    """Standard deviation from beam to beam."""
    hot_beams: Count = 2
    """Beams with too much gain."""
    hot_beam_db: Level = 2.0


@dataclass(frozen=True, slots=True)
class PictureSection:
    """Log compression to 8 bits."""

    black_db: Level = -17.0
    """Power shown as 0, relative to the floor."""
    dynamic_range_db: Positive = 50.0
    """From 0 to 255."""
    gamma: Positive = 1.0


@dataclass(frozen=True, slots=True)
class PlacedLandmark:
    """A landmark of the scene's set on the floor."""

    id: Integer
    ground_m: Positive
    """Distance of its centre from the floor's origin, along the floor."""
    azimuth_deg: Finite
    """Direction of its centre, positive to the right of pan 0."""
    orientation_deg: Finite = 0.0
    """Where the first sector begins, counter-clockwise seen from above, from the right of a sonar
    at pan 0."""
    bright_db: Level = 12.0
    symbol_db: Level = 11.0
    plate_db: Level = -7.0
    relief_m: NotNegative = 0.0
    """Mean height of the gravel that ring and sectors are made of."""
    lean_deg: Lean = 0.0
    """One edge of the disc is raised by this angle."""
    lean_towards_deg: Finite = 0.0
    """Azimuth of that edge from the disc's middle."""
    silted: Share = 0.0
    """Of its area, covered by silt."""


@dataclass(frozen=True, slots=True)
class PlacedObject:
    """Another object on the floor, placed like a landmark. None: the usual value of its kind."""

    kind: str
    ground_m: Positive
    azimuth_deg: Finite
    orientation_deg: Finite = 0.0
    size_m: Positive | None = None
    width_m: Positive | None = None
    bright_db: Level | None = None
    plate_db: Level = -7.0
    relief_m: NotNegative = 0.0
    """As for a landmark, on its bright parts."""
    number: Count = 0
    """Of a symbol that no ID has: its seed."""
    lean_deg: Lean = 0.0
    """This and the next two: as for a landmark."""
    lean_towards_deg: Finite = 0.0
    silted: Share = 0.0


Placed = PlacedLandmark | PlacedObject


def position_of(item: Placed) -> tuple[float, float]:
    """(x, y) of an object's centre: to the right and forward of the floor's origin, m."""
    azimuth = math.radians(item.azimuth_deg)
    return item.ground_m * math.sin(azimuth), item.ground_m * math.cos(azimuth)


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything that the simulator needs. The same scene and version give the same bytes."""

    name: str = "scene"
    seed: Count = 1
    frames: AtLeastOne = 160
    rate_hz: Annotated[float, bounds(1e-3, 1e6)] = 4.0
    landmark_set: LandmarkSet = field(default_factory=lambda: load_landmarks("basin"))
    sonar: SonarSection = SonarSection()
    motion: MotionSection = MotionSection()
    floor: FloorSection = FloorSection()
    fading: FadingSection = FadingSection()
    multipath: MultipathSection = MultipathSection()
    fish: FishSection = FishSection()
    noise: NoiseSection = NoiseSection()
    picture: PictureSection = PictureSection()
    landmarks: tuple[PlacedLandmark, ...] = field(default=(), metadata={"key": "landmark"})
    objects: tuple[PlacedObject, ...] = field(default=(), metadata={"key": "object"})

    @property
    def items(self) -> tuple[Placed, ...]:
        """All that lies on the floor, landmarks first."""
        return *self.landmarks, *self.objects


@dataclass(frozen=True, slots=True)
class HeldPlate:
    """A drawn plate, and how it is held. Its pose swings about what is stated."""

    landmark: int
    """Its ID; of `others` if it is none of the set's."""
    range_m: Positive = 1.0
    bearing_deg: Finite = 0.0
    turned_deg: Finite = 0.0
    """Counter-clockwise, in its own plane."""
    tilt_deg: Finite = 0.0
    """Between its plane and that of the image; a plate on the floor: the grazing angle's rest."""
    axis_deg: Finite = 0.0
    """Of the tilt, counter-clockwise from across."""
    mirrored: bool = False
    bright_db: Finite = 9.0
    """Of its rough cells over what is round it."""
    dark_db: Finite = -6.0
    known: bool = True
    """Whether it is of the set, and so in the truth."""


@dataclass(frozen=True, slots=True)
class PlateScene:
    """A recording of drawn plates, written as polar images."""

    name: str = "plates"
    landmark_set: DrawnSet = field(
        default_factory=lambda: cast(DrawnSet, load_landmarks("actag24h10"))
    )
    others: DrawnSet | None = None
    """Drawings for plates that are none of the set's."""
    plate: tuple[HeldPlate, ...] = (HeldPlate(0),)
    seed: Count = 0
    frames: AtLeastOne = 60
    range_min_m: NotNegative = 0.2
    range_max_m: Positive = 1.8
    field_of_view_deg: Positive = 60.0
    beams: Count = 256
    bins: Count = 400
    beam_width_deg: Positive = 0.6
    pulse_m: Positive = 0.006
    rate_hz: Positive = 10.0
    swing: Share = 0.5
    """How much the poses change: 1 is .1 m, 12 deg."""
    streaks: Count = 3
    """Lines of echoes behind each plate."""
    light_db: NotNegative = 3.0
    clutter: Count = 3
    """Bright figures of about a plate's size."""
    floor_db: Finite = 14.0
    """Of the background over the noise."""
    height_m: NotNegative = 0.0
    """Of the sonar over the plates: one without tilt and swing lies on the floor."""
    blank_every: Count = 0
    """Each so many frames one shows noise alone; 0: none."""


AnyScene = Scene | PlateScene


def load_scene(source: str | Path) -> AnyScene:
    """Read a scene: the name of a built-in one ("paper", "basin", ...) or a TOML file.

    Raises UsageError if there is no such scene or file, or if the file is no valid scene.
    """
    path = named_file(source, BUILT_IN)
    if path is None:
        built_in = ", ".join(sorted(p.stem for p in BUILT_IN.glob("*.toml")))
        raise UsageError(f"no scene {brief(str(source))}: neither a file nor built in ({built_in})")
    with as_usage():
        return scene_from_table(read_toml(path), str(path))


def scene_from_table(table: Mapping[str, Any], where: str) -> AnyScene:
    """A scene from the keys of its TOML. Raises SonarrecError, which begins with `where`."""
    plates = table.get("kind") == "plates"
    values = {key: value for key, value in table.items() if key != "kind" or not plates}
    for key in {"landmark_set", "others"} & set(values):
        values[key] = chosen = _landmark_set(values[key], where)
        if isinstance(chosen, DrawnSet) != plates:
            needed = "[[landmark]] and no kind" if plates else 'kind = "plates" and [[plate]]'
            raise SonarrecError(f"{where}: {key} {chosen.name}: a scene of it has {needed}")
    scene: AnyScene = from_table(cast(Any, PlateScene if plates else Scene), values, where)
    fault = _fault(scene)
    if fault is not None:
        raise SonarrecError(f"{where}: {fault}")
    return scene


def check_scene(scene: Scene, where: str) -> None:
    """Raise SonarrecError if a scene that was built in Python is not valid."""
    scene_from_table(scene_table(scene), where)


def _landmark_set(listed: Any, where: str) -> LandmarkSet:
    if isinstance(listed, str):
        return load_landmarks(listed, where)
    return landmarks_from_table(listed, f"{where}: [landmark_set]")


def _fault(scene: AnyScene) -> str | None:
    """How values of a scene contradict each other; None if they do not."""
    if isinstance(scene, PlateScene):
        if scene.range_min_m >= scene.range_max_m or not (scene.beams and scene.bins):
            return "range_min_m must be below range_max_m, beams and bins be some"
        for plate in scene.plate:
            set_name = "landmark_set" if plate.known else "others"
            family: DrawnSet | None = getattr(scene, set_name)
            if family is None or plate.landmark not in family.ids:
                return f"there is no ID {plate.landmark} in {set_name}"
            if not scene.range_min_m < plate.range_m < scene.range_max_m:
                return f"ID {plate.landmark}: range_m = {plate.range_m:g} is outside of the window"
        return None
    sonar, motion, discs = scene.sonar, scene.motion, scene.landmark_set
    wrong = scene_sonar(scene).contradiction()
    if wrong is not None:
        return f"[sonar], with its errors, contradicts itself: {wrong}"
    if sonar.height_m + motion.heave_m >= sonar.range_max_m or motion.heave_m >= sonar.height_m:
        return "heave_m leaves no floor in the range window"
    if not motion.pan_min_deg <= motion.pan_start_deg <= motion.pan_max_deg:
        return "pan_start_deg must lie between pan_min_deg and pan_max_deg"
    sweep, view = motion.pan_max_deg - motion.pan_min_deg, sonar.field_of_view_deg
    if sweep > 300:
        return "the pan sweep must be 300 deg or less"
    if sweep + view > 360:
        return (
            f"the sweep of {sweep:g} deg and the view of {view:g} deg go round and see the same "
            "floor twice; together they must be 360 deg or less"
        )
    if motion.speeds.any() and any(item.lean_deg for item in scene.items):
        return "discs lean before a standing sonar only, not a vehicle's"
    for item in scene.items:
        if isinstance(item, PlacedLandmark):
            if item.id not in discs.ids:
                known = ", ".join(map(str, discs.ids))
                return f"landmark id {item.id} is not in the set {discs.name!r} ({known})"
        elif item.kind not in KINDS:
            return f"unknown kind of object {brief(item.kind)}; known: {', '.join(KINDS)}"
    return None


def scene_table(scene: Scene) -> dict[str, Any]:
    """The scene as plain TOML values, as load_scene reads them."""
    return {f.metadata.get("key", f.name): _plain(getattr(scene, f.name)) for f in fields(scene)}


def _plain(value: Any) -> Any:
    """A field of a Scene as a TOML value. Fields that are None are left out."""
    if isinstance(value, LandmarkSet):
        return value.as_table()
    if isinstance(value, tuple):
        return [_plain(row) for row in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {name: v for name, v in asdict(value).items() if v is not None}
    return value


def scene_bearings(scene: Scene) -> FloatArray:
    """(beams,) bearing of the centre of every beam, deg, from left to right."""
    beams = scene.sonar.beams
    share = (np.arange(beams) + 0.5) / beams * 2 - 1
    if scene.sonar.bearings == "didson":
        # Spacing proportional to 0.37 deg in the middle, falling to 0.22 deg at both edges.
        share = (0.37 * share - 0.075 * share * np.abs(share)) / (0.37 - 0.075)
    return np.asarray(share * scene.sonar.field_of_view_deg / 2)


def scene_sonar(scene: AnyScene) -> Sonar:
    """The geometry that the scene's sonar.toml states, with its errors."""
    sonar = scene if isinstance(scene, PlateScene) else scene.sonar
    stated = Sonar(
        layout="polar",
        range_min_m=sonar.range_min_m,
        range_max_m=sonar.range_max_m,
        field_of_view_deg=sonar.field_of_view_deg,
        tilt_deg=30.0,
        height_m=sonar.height_m or None,
        frame_rate_hz=scene.rate_hz,
        beam_width_deg=sonar.beam_width_deg,
    )
    if isinstance(scene, PlateScene):
        return stated
    sonar = scene.sonar
    uneven = sonar.layout == "polar" and sonar.bearings != "even"
    return replace(
        stated,
        layout=sonar.layout,
        tilt_deg=sonar.tilt_deg + sonar.tilt_error_deg,
        height_m=sonar.height_m + sonar.height_error_m,
        bearings_deg=tuple(np.round(scene_bearings(scene), 4).tolist()) if uneven else None,
    )


def scene_fan(scene: AnyScene) -> Fan:
    """The fan of the scene's images. A polar layout has the fan that the reader makes of it."""
    stated = scene_sonar(scene).complete(scene.name)
    if isinstance(scene, PlateScene):
        return fan_for_polar(stated, scene.bins)
    sonar = scene.sonar
    if sonar.layout == "polar":
        return fan_for_polar(stated, sonar.range_bins)
    scale = (sonar.range_max_m - sonar.range_min_m) / sonar.range_bins
    half_width = sonar.range_max_m * math.sin(math.radians(sonar.field_of_view_deg / 2))
    return fan_for_image(stated, sonar.range_bins, 2 * math.floor(half_width / scale) + 1)
