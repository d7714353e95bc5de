"""The acoustic simulator: recordings with known truth.

The floor is a grid of scatterers: a polar grid, or squares if the sonar is on a vehicle. The echo
of a beam is the coherent sum over all scatterers of reflectivity times beam pattern. So speckle,
and how it behaves when the sonar moves, follow from the geometry. One matrix holds the main lobes,
the side lobes and the leaks between beams.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sonarrec.geometry import in_image, pixel_from_polar, points_on_disc
from sonarrec.landmarks import load_landmarks
from sonarrec.records import ByteImage, Fan, FloatArray, SonarrecError, UsageError
from sonarrec.remote.urls import local
from sonarrec.simulation.fish import Fishes, Shoal
from sonarrec.simulation.grid import PolarGrid, SquareGrid, corners
from sonarrec.simulation.laid import raised_m
from sonarrec.simulation.motion import Pose, ar1, poses
from sonarrec.simulation.multipath import Multipath, shifted
from sonarrec.simulation.plane import FLAT, Plane, within_a_turn
from sonarrec.simulation.receiver import Picture, Receiver, vertical_pattern
from sonarrec.simulation.scene import (
    PlacedLandmark,
    PlacedObject,
    Scene,
    check_scene,
    load_scene,
    place_of,
    scene_fan,
    scene_sonar,
    scene_table,
    travels,
)
from sonarrec.simulation.things import object_radius
from sonarrec.simulation.world import View, World
from sonarrec.sonar import Geometry, Sonar

COMPANIONS = ("gt.csv", "scene.toml", "sonar.toml", "landmarks.toml")
"""Files written beside the frames."""


@dataclass(frozen=True, slots=True)
class LandmarkTruth:
    """A landmark that is at least partly in view of a frame: a row of gt.csv.

    x_px, y_px: centre in fan pixels. range_m: slant range. bearing_deg: positive to the right.
    visible: share of the disc's area that is inside the fan image, 0 to 1. orientation_deg: where
    the first sector begins, counter-clockwise from the image's right, seen from above.
    """

    landmark: int
    x_px: float
    y_px: float
    range_m: float
    bearing_deg: float
    visible: float
    orientation_deg: float


TRUTH_COLUMNS = ("frame", *(f.name for f in fields(LandmarkTruth)))
"""Of gt.csv."""


def truth_rows(frame: int, truth: Iterable[LandmarkTruth]) -> Iterator[list[object]]:
    """The rows of gt.csv for one frame."""
    return ([frame, *asdict(landmark).values()] for landmark in truth)


@dataclass(frozen=True, slots=True)
class DistractorTruth:
    """Any other object in view, even if something hides it. The fields are as in LandmarkTruth."""

    kind: str
    x_px: float
    y_px: float
    range_m: float
    bearing_deg: float
    visible: float
    orientation_deg: float


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """One simulated ping.

    image: uint8, (fan.rows, fan.columns), or (range bins, beams) if polar. fan: the geometry as
    sonar.toml states it. pan_deg: the true pan, yaw jitter included. truth, distractors: what is in
    view, in the scene's order.
    """

    index: int
    timestamp_ns: int
    image: ByteImage
    fan: Fan
    pan_deg: float
    truth: tuple[LandmarkTruth, ...]
    distractors: tuple[DistractorTruth, ...]


def _signal_gain_db(scene: Scene, rng: np.random.Generator) -> FloatArray:
    """(frames,) gain of the echoes, dB: single frames fade, and bursts of frames."""
    fading, frames = scene.fading, scene.frames
    depths, singles, starts, bursts = rng.spawn(4)
    depth = fading.depth_db * depths.gamma(4.0, 0.25, frames)
    gain = -depth * (singles.random(frames) < fading.frame_probability)
    begins = np.flatnonzero(starts.random(frames) < fading.burst_probability)
    for begin in begins:
        length = 1 + bursts.geometric(1 / max(fading.burst_frames, 1.0))
        part = gain[begin : begin + length]
        shape = np.sin(np.pi * (np.arange(len(part)) + 1) / (length + 1)) ** 0.5
        np.minimum(part, -depth[begin] * shape, out=part)
    return np.asarray(gain)


def visible_share(
    fan: Fan,
    pose: Pose,
    x_m: float,
    y_m: float,
    radius_m: float,
    plane: Plane = FLAT,
    lean: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Share of a disc's area that is inside the fan image, 0 to 1.

    x_m, y_m: its centre on the floor. lean: by how much the disc leans and the azimuth towards
    which it does, deg; its lower edge touches the floor.
    """
    if _aside(fan, pose, x_m, y_m, 2 * radius_m, plane):
        return 0.0
    dx, dy, up = _disc(radius_m, lean)
    slant, bearing = plane.seen(pose, x_m + dx, y_m + dy, up)
    return float(np.mean(in_image(fan, slant, bearing)))


def _aside(fan: Fan, pose: Pose, x_m: float, y_m: float, reach_m: float, plane: Plane) -> bool:
    """Whether everything within reach_m of a place on the floor is certainly out of view.

    Always False if the sonar rolls or the floor slopes.
    """
    if pose.roll_deg or plane.slope_deg:
        return False
    dx, dy = x_m - pose.x_m, y_m - pose.y_m
    away = math.hypot(dx, dy)
    if away <= reach_m:
        return False
    middle = (fan.bearing_min_deg + fan.bearing_max_deg) / 2
    off = abs(float(within_a_turn(math.degrees(math.atan2(dx, dy)) - pose.pan_deg - middle)))
    off -= math.degrees(math.asin(reach_m / away))
    return away - reach_m > fan.range_max_m or off > fan.bearing_max_deg - middle


@lru_cache(maxsize=256)
def _disc(
    radius_m: float, lean: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray | float]:
    """Points of a disc: to the right of its centre, ahead of it, and up, m.

    lean: as in `visible_share`.
    """
    dx, dy = points_on_disc(radius_m, 2000)
    up: FloatArray | float = 0.0
    if lean[0]:
        tilt, towards = math.radians(lean[0]), math.radians(lean[1])
        along = dx * math.sin(towards) + dy * math.cos(towards)
        up = (along + radius_m) * math.sin(tilt)
        level = along * (math.cos(tilt) - 1)
        dx, dy = dx + level * math.sin(towards), dy + level * math.cos(towards)
    return dx, dy, up


def _truth(
    scene: Scene, fan: Fan, pose: Pose, fishes: Fishes | None
) -> tuple[tuple[LandmarkTruth, ...], tuple[DistractorTruth, ...]]:
    """Landmarks and distractors in view of a frame, rounded to the digits of gt.csv."""
    radius = scene.landmark_set.radius_m
    plane = Plane.of(scene)
    things: list[tuple[PlacedLandmark | PlacedObject, float]]
    things = [(item, radius) for item in scene.landmarks]
    things += [(item, object_radius(scene, item)) for item in scene.objects]
    landmarks, distractors = [], []
    for item, size in things:
        x, y = place_of(item)
        lean = (item.lean_deg, item.lean_towards_deg)
        share = round(visible_share(fan, pose, x, y, size, plane, lean), 4)
        if share == 0:
            continue
        seen = plane.seen(pose, x, y, raised_m(item, size))
        row = truth_row(fan, seen, share, item.orientation_deg + pose.pan_deg)
        if isinstance(item, PlacedObject):
            distractors.append(DistractorTruth(item.kind, *row))
        else:
            landmarks.append(LandmarkTruth(item.id, *row))
    if fishes is not None:
        slant, bearing = plane.seen(pose, fishes.x_m, fishes.y_m, fishes.up_m)
        for n in np.flatnonzero(in_image(fan, slant, bearing)):
            turn = 90 - float(fishes.heading_deg[n]) + pose.pan_deg
            distractors.append(
                DistractorTruth("fish", *truth_row(fan, (slant[n], bearing[n]), 1.0, turn))
            )
    return tuple(landmarks), tuple(distractors)


def truth_row(
    fan: Fan, seen: tuple[FloatArray | float, FloatArray | float], share: float, turn_deg: float
) -> tuple[float, float, float, float, float, float]:
    """The fields of a row of truth after the thing's name, rounded.

    seen: (slant range in m, bearing in deg). share: the part of it in view, 0 to 1. turn_deg: its
    orientation.
    """
    slant, bearing = (float(value) for value in seen)
    column, row = pixel_from_polar(fan, slant, bearing)
    return (
        round(float(column), 3),
        round(float(row), 3),
        round(slant, 5),
        round(bearing, 4),
        share,
        round(turn_deg % 360, 3),
    )


@dataclass(frozen=True, slots=True)
class _Fading:
    """How the echoes fade from frame to frame.

    time_s: (frames,). signal_db: (frames,) gain of the echoes. drift_db: (frames,) gain of echoes
    and noise. object_db, afterglow_db: (frames, things), landmarks first. patches: (frames,
    World.PATCHES), standard normal.
    """

    time_s: FloatArray
    signal_db: FloatArray
    drift_db: FloatArray
    object_db: FloatArray
    afterglow_db: FloatArray
    patches: FloatArray

    @classmethod
    def of(cls, scene: Scene) -> _Fading:
        """Draw the fading of a scene. With fewer frames it is the beginning of the same fading."""
        # That is why each process has a generator of its own.
        signal, objects, patches, glow, glow_changes, drift = np.random.default_rng(
            [scene.seed, 5]
        ).spawn(6)
        fading, noise, frames = scene.fading, scene.noise, scene.frames
        things, step_s = len(scene.landmarks) + len(scene.objects), 1 / scene.rate_hz

        def changing(rng: np.random.Generator, count: int) -> FloatArray:
            return ar1(rng, frames, count, step_s, fading.time_s)

        time_s = np.arange(frames) * step_s
        swing = np.sin(2 * np.pi * (time_s / noise.gain_drift_s + drift.uniform()))
        return cls(
            time_s,
            _signal_gain_db(scene, signal),
            noise.gain_drift_db * swing,
            fading.object_db * changing(objects, things),
            glow.normal(0, 3, things) + 2 * changing(glow_changes, things),
            changing(patches, World.PATCHES),
        )


class _Reception:
    """Turns the scatterers in view into the power that the sonar receives."""

    def __init__(self, scene: Scene, receiver: Receiver, range_m: FloatArray) -> None:
        """range_m: (bins,) slant ranges of the centres of the range bins."""
        self._scene, self._receiver = scene, receiver
        self._rng = np.random.default_rng([scene.seed, 4])
        self._noise = np.float32(10 ** (-scene.noise.snr_db / 20) / math.sqrt(2))
        bin_m = scene_fan(scene).window_m / scene.sonar.range_bins
        self._glow_sigma = min(max(scene.fading.ghost_blur_m / bin_m, 0.3), len(range_m))
        self._glow_shift = round(scene.fading.ghost_shift_m / bin_m)
        self._late = Multipath(scene, range_m)

    def power(self, view: View, pose: Pose, time_s: float, signal_db: float) -> np.ndarray:
        """(bins, beams) float32 power of the next frame. signal_db: gain of its echoes, dB."""
        scene, receiver = self._scene, self._receiver
        patterns = receiver.patterns(view.azimuth_deg, pose.pan_deg)
        strength = vertical_pattern(scene, view.depression_deg, view.sine, pose.pitch_deg)
        strength = strength.astype(np.float32)
        field = receiver.beams(view.echoes * strength, patterns)
        # An afterglow is the sum of many late paths: smooth in power, not coherent.
        glow = (view.glow * strength**2) @ np.square(np.abs(patterns)).T
        glow = cv2.GaussianBlur(glow, (0, 0), sigmaX=1.0, sigmaY=self._glow_sigma)
        glow = shifted(glow, self._glow_shift)
        signal = np.float32(10 ** (signal_db / 20))
        hiss = self._rng.standard_normal((*field.shape, 2), dtype=np.float32)
        field = field * signal
        random: np.ndarray | np.float32 = self._noise
        late_power = None
        if self._late.comes:
            # Speckle that is new in every frame is hiss, only not as even.
            late_power = self._late.power(field.real**2 + field.imag**2, time_s)
            random = np.sqrt(random**2 + late_power / 2)
        field = field + hiss.view(np.complex64)[..., 0] * random
        power = field.real**2 + field.imag**2
        incoherent = np.float32(1 - scene.floor.coherence)
        if incoherent > 0:
            power = power * np.float32(scene.floor.coherence)
            even = receiver.even(view.power * strength**2, patterns)
            power += incoherent * even * signal**2
            if late_power is not None:
                power += incoherent * late_power
        power += glow * signal**2
        if scene.noise.smear:
            smooth = cv2.GaussianBlur(power, (0, 0), sigmaX=0.8, sigmaY=2.0)
            power += np.float32(scene.noise.smear) * (smooth - power)
        return np.asarray(power)


def render(
    scene: Scene, path: Sequence[Pose] | None = None, ground: Scene | None = None
) -> Iterator[SimulatedFrame]:
    """Render the scene's frames in order. The same scene gives the same bytes.

    path: the sonar's pose in every frame, such as a vehicle's; replaces the scene's motion.
    ground: a scene whose range window and sweep, seen from the floor's origin, cover all the floor
    that the path shows; default: the scene itself. Raises SonarrecError if the scene contradicts
    itself.
    """
    check_scene(scene, scene.name)
    fan, sonar = scene_fan(scene), scene.sonar
    path = poses(scene) if path is None else path
    floor_scene = ground or scene
    roams = ground is None and travels(scene.motion)
    grid = SquareGrid(scene, path) if roams else PolarGrid(floor_scene)
    world = World(floor_scene, np.random.default_rng([scene.seed, 1]), grid)
    receiver = Receiver(scene, np.random.default_rng([scene.seed, 3]))
    bin_m = fan.window_m / sonar.range_bins
    range_m = sonar.range_min_m + (np.arange(sonar.range_bins) + 0.5) * bin_m
    reception = _Reception(scene, receiver, range_m)
    picture = Picture(scene, fan)
    fading = _Fading.of(scene)
    shoal = Shoal(scene, *corners(grid)) if scene.fish.number else None
    for index, pose in enumerate(path):
        time_s = fading.time_s[index]
        world.fade(fading.object_db[index], fading.patches[index], fading.afterglow_db[index])
        heave = pose.height_m - sonar.height_m
        moved = np.array([pose.x_m, pose.y_m, heave]) * (math.sqrt(2) / scene.floor.speckle_m)
        view = world.view(range_m, pose, [time_s / scene.floor.speckle_s, *moved])
        fishes = shoal.at(time_s) if shoal else None
        if shoal and fishes:
            rng = np.random.default_rng([scene.seed, 15, index])
            shoal.swim_into(view, range_m, pose, fishes, rng)
        power = reception.power(view, pose, time_s, fading.signal_db[index])
        power *= (receiver.gain * np.float32(10 ** (fading.drift_db[index] / 20))) ** 2
        truth, distractors = _truth(scene, fan, pose, fishes)
        yield SimulatedFrame(
            index=index,
            timestamp_ns=round(index * 1e9 / scene.rate_hz),
            image=picture(power),
            fan=fan,
            pan_deg=pose.pan_deg,
            truth=truth,
            distractors=distractors,
        )


def simulate(
    scene: str | Path | Scene = "paper",
    out: str | Path = "simulated",
    *,
    seed: int | None = None,
    frames: int | None = None,
    image_format: str = "png",
) -> Path:
    """Render a recording with known truth into `out`, and return it.

    scene: the name of a built-in one, a TOML file or a Scene. out: a new folder, or NAME.mcap.
    seed, frames: replace those of the scene. image_format: "png" or "mcap". Raises SonarrecError
    if the scene cannot be used, or if `out` cannot be written or is in use.
    """
    chosen = scene if isinstance(scene, Scene) else load_scene(str(scene))
    chosen = replace(
        chosen,
        seed=chosen.seed if seed is None else seed,
        frames=chosen.frames if frames is None else frames,
    )
    write_recording(chosen, Path(local(out)), image_format)
    return Path(out)


def write_recording(
    scene: Scene,
    out: Path,
    image_format: str = "png",
    progress: Callable[[int], None] | None = None,
    *,
    schema: str = "sensor_msgs/msg/Image",
    compression: str = "zstd",
) -> None:
    """Write frames, sonar.toml, gt.csv and scene.toml.

    out: an empty or new folder for NNNNNN.png or frames.mcap; or a file NAME.mcap, beside which
    NAME.sonar.toml, NAME.gt.csv and NAME.scene.toml are written. progress: called after each frame
    with the number of frames done. schema, compression: of an MCAP, see McapImageWriter. If
    messages of the schema state the sonar's geometry, sonar.toml states only the rest. Raises
    SonarrecError if `out` cannot be written or is in use.
    """
    from sonarrec.simulation.mcap_writer import check_schema

    if image_format not in ("png", "mcap"):
        raise SonarrecError(f'image format must be "png" or "mcap", not {image_format!r}')
    single_file = out.suffix == ".mcap"
    if single_file and image_format != "mcap":
        raise UsageError(f"{out}: a name ending in .mcap needs --format mcap")
    sonar = scene_sonar(scene)
    polar = sonar.layout == "polar"
    if image_format == "mcap":
        check_schema(schema, compression, polar)
    folder, prefix = (out.parent, f"{out.stem}.") if single_file else (out, "")
    _check_free(out, [folder / f"{prefix}{name}" for name in COMPANIONS])
    frames = render(scene)
    # A scene that cannot be rendered leaves no folder behind.
    frames = chain([next(frames)], frames)
    if image_format == "mcap":
        geometry = sonar.complete(scene.name) if polar else None
        file_name = out if single_file else out / "frames.mcap"
        frames = _to_mcap(frames, file_name, schema, compression, geometry)
        sonar = _stated_beside(sonar, schema)
    else:
        frames = _to_png(frames, out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / f"{prefix}gt.csv").open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(TRUTH_COLUMNS)
            for frame in frames:
                table.writerows(truth_rows(frame.index, frame.truth))
                if progress:
                    progress(frame.index + 1)
        _describe(scene, sonar, folder, prefix)
    except OSError as error:
        raise SonarrecError(f"{out}: cannot be written ({error.strerror})") from None


def _check_free(out: Path, companions: Sequence[Path]) -> None:
    """Raise SonarrecError if `out` or a file beside it exists.

    Empty folders may exist, unless `out` is a single file.
    """
    single_file = out.suffix == ".mcap"
    for path in (out, *companions):
        if path.is_file() or (path.is_dir() and (single_file or any(path.iterdir()))):
            raise SonarrecError(f"{path}: already exists and is not empty; choose another --out")


def _stated_beside(sonar: Sonar, schema: str) -> Sonar:
    """What sonar.toml beside an MCAP states: only what messages of this schema do not."""
    from sonarrec.simulation.mcap_writer import is_polar

    if not is_polar(schema):
        return sonar
    return Sonar(
        tilt_deg=sonar.tilt_deg, height_m=sonar.height_m, frame_rate_hz=sonar.frame_rate_hz
    )


def _describe(scene: Scene, sonar: Sonar, folder: Path, prefix: str) -> None:
    """Write scene.toml, sonar.toml and, if the landmark set is not basin, landmarks.toml."""
    documents = {"scene": scene_table(scene)}
    if scene.landmark_set != load_landmarks("basin"):
        documents["landmarks"] = scene.landmark_set.as_table()
    # sonar.toml comes last: a folder without geometry is not taken for a whole recording.
    documents["sonar"] = {"sonar": sonar.as_table()}
    write_documents(folder, documents, prefix)


def write_documents(folder: Path, documents: Mapping[str, Any], prefix: str = "") -> None:
    """Write each document as <prefix><name>.toml, in order. Raises OSError."""
    import tomli_w  # only writers of TOML need it

    for name, document in documents.items():
        text = tomli_w.dumps(document)
        (folder / f"{prefix}{name}.toml").write_text(text, encoding="utf-8", newline="")


def _to_png(frames: Iterator[SimulatedFrame], folder: Path) -> Iterator[SimulatedFrame]:
    """Write each frame as NNNNNN.png into the folder, and yield it."""
    for frame in frames:
        write_image(folder / f"{frame.index:06d}.png", frame.image)
        yield frame


def write_image(path: Path, image: ByteImage) -> None:
    """Write an image as a PNG. Raises OSError."""
    # Not by imwrite, which dies of names that are not UTF-8.
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def _to_mcap(
    frames: Iterator[SimulatedFrame],
    path: Path,
    schema: str,
    compression: str,
    sonar: Geometry | None,
) -> Iterator[SimulatedFrame]:
    """Write each frame as a message of an MCAP, and yield it.

    sonar: the geometry for polar pings; None for fan images.
    """
    from sonarrec.simulation.mcap_writer import McapImageWriter

    with McapImageWriter(path, schema=schema, compression=compression, sonar=sonar) as writer:
        for frame in frames:
            writer.write(frame.timestamp_ns, frame.image)
            yield frame
