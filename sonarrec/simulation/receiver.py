"""The simulated receiver: beam patterns, leaks, gains, noise, late echoes, the pulse, the image."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.scene import NO_ECHO_DB, Scene, scene_bearings
from sonarrec.simulation.world import View
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import in_fan, polar_from_pixel

GROUP = 8  # neighbouring beams that share a gain; beams at multiples of this distance fire together
MOST_BANDS = 100  # bands of surface echo, at most; one more would be 300 dB below the first


def vertical_pattern(
    scene: Scene, depression_deg: FloatArray, sine: FloatArray, pitch_deg: float
) -> FloatArray:
    """Amplitude of floor echoes, relative to the beam's axis; 0 where there is no floor.

    A two-way Gaussian beam about the true tilt and pitch; the power also goes with the sine to the
    power of the angle exponent. depression_deg: angle below the sonar's horizon. sine: of the
    grazing angle; 0 where there is no floor.
    """
    sonar = scene.sonar
    on_axis = max(math.sin(math.radians(sonar.tilt_deg)), 0.05)
    off_axis = (depression_deg - sonar.tilt_deg - pitch_deg) / sonar.vertical_beam_deg
    beam = np.exp(-4 * math.log(2) * off_axis**2)
    power = beam * (sine / on_axis) ** scene.floor.angle_exponent
    return np.asarray(np.where(sine > 0, np.sqrt(power), 0.0))


class Receiver:
    """Turns the scatterers in view into the power that the sonar receives."""

    def __init__(self, scene: Scene) -> None:
        sonar, noise, beams = scene.sonar, scene.noise, scene.sonar.beams
        self._scene, self._bearings = scene, scene_bearings(scene)
        self.bin_m = (sonar.range_max_m - sonar.range_min_m) / sonar.range_bins
        self.range_m = sonar.range_min_m + (np.arange(sonar.range_bins) + 0.5) * self.bin_m
        rng = np.random.default_rng([scene.seed, 3])
        distance = np.abs(np.arange(beams)[:, None] - np.arange(beams)[None, :])
        together = (distance % GROUP == 0) & (distance > 0)
        leak = 10 ** (sonar.cross_talk_db / 20) * (distance > 0)
        leak += 10 ** (sonar.stray_db / 20) * together / np.maximum(distance / GROUP, 1)
        phase = rng.uniform(0, 2 * np.pi, (beams, beams))
        mixed = np.eye(beams) + leak * np.exp(1j * phase)
        # By beam that leaks: the real and the imaginary part of what each beam gets, in turns.
        self._leak = np.ascontiguousarray(mixed.T, np.complex64).view(np.float32)
        gain = np.repeat(rng.normal(0, noise.group_gain_db, -(-beams // GROUP)), GROUP)[:beams]
        gain += rng.normal(0, noise.beam_gain_db, beams)
        gain[rng.permutation(beams)[: noise.hot_beams]] += noise.hot_beam_db
        self._gain = (10 ** (gain / 20)).astype(np.float32)
        half = max(math.ceil(1.5 * sonar.pulse_m / self.bin_m), 1)
        tap = np.arange(-half, half + 1) * self.bin_m / sonar.pulse_m
        pulse = np.exp(-2 * math.log(2) * tap**2)
        self._pulse = (pulse / np.sqrt(np.sum(pulse**2))).astype(np.float32)
        self._rng = np.random.default_rng([scene.seed, 4])
        self._phases = np.random.default_rng([scene.seed, 14]).uniform(0, 2 * np.pi, 2)

    def patterns(self, azimuth_deg: FloatArray, pan_deg: float) -> np.ndarray:
        """(azimuths, beams) complex64 two-way amplitude by which each beam receives each azimuth.

        A Gaussian lobe, of half power at beam_width_deg / 2, and side lobes, which alternate in
        sign and fall with the angle; scaled so that a floor of unit scatterers gives unit power.
        """
        sonar = self._scene.sonar
        offset = self._bearings + (pan_deg - azimuth_deg[:, None])
        scaled = offset.astype(np.float32) / sonar.beam_width_deg
        main = np.exp(-2 * math.log(2) * scaled**2)
        level = 10 ** (sonar.side_lobe_db / 20)
        side = level * np.cos(np.pi * scaled) / np.sqrt(1 + (scaled / 6) ** 2)
        pattern: np.ndarray = main + (1 - main) * side
        pattern /= np.sqrt(np.vdot(pattern, pattern) / np.float32(len(self._bearings)))
        return (pattern @ self._leak).view(np.complex64)

    def power(
        self, view: View, pose: Pose, time_s: float, signal_db: float, drift_db: float
    ) -> np.ndarray:
        """(bins, beams) float32 power of the next frame, relative to the floor.

        signal_db: gain of its echoes. drift_db: of echoes and noise.
        """
        scene = self._scene
        patterns = self.patterns(view.azimuth_deg, pose.pan_deg)
        strength = vertical_pattern(scene, view.depression_deg, view.sine, pose.pitch_deg)
        strength = strength.astype(np.float32)
        signal = np.float32(10 ** (signal_db / 20))
        field = self._pulsed((view.echoes * strength) @ patterns) * signal
        received = np.square(patterns.real) + np.square(patterns.imag)
        hiss = self._rng.standard_normal((*field.shape, 2), dtype=np.float32)
        random: np.ndarray | np.float32 = np.float32(
            10 ** (-scene.noise.snr_db / 20) / math.sqrt(2)
        )
        late = self._late(field.real**2 + field.imag**2, time_s)
        if late is not None:  # speckle that is new in every frame is hiss, only not as even
            random = np.sqrt(random**2 + late / 2)
        field = field + hiss.view(np.complex64)[..., 0] * random
        power = field.real**2 + field.imag**2
        incoherent = np.float32(1 - scene.floor.coherence)
        if incoherent > 0:
            power = power * np.float32(scene.floor.coherence)
            even = (view.power * strength**2) @ received
            even = cv2.sepFilter2D(even, -1, np.ones(1, np.float32), np.square(self._pulse))
            power += incoherent * np.asarray(even) * signal**2
            if late is not None:
                power += incoherent * late
        # An afterglow is the sum of many late paths: smooth in power, not coherent.
        glow = self._blurred((view.glow * strength**2) @ received, 1.0, scene.fading.ghost_blur_m)
        power += shifted(glow, round(scene.fading.ghost_shift_m / self.bin_m)) * signal**2
        if scene.noise.smear:
            smooth = cv2.GaussianBlur(power, (0, 0), sigmaX=0.8, sigmaY=2.0)
            power += np.float32(scene.noise.smear) * (smooth - power)
        power *= (self._gain * np.float32(10 ** (drift_db / 20))) ** 2
        return np.asarray(power)

    def _pulsed(self, field: np.ndarray) -> np.ndarray:
        """(bins, beams) complex64 echoes as the pulse makes them."""
        # The pulse acts along range only: a column filter over real and imaginary parts.
        pairs: np.ndarray = field.view(np.float32).reshape(*field.shape, 2)
        pairs = cv2.sepFilter2D(pairs, -1, np.ones(1, np.float32), self._pulse)
        return np.ascontiguousarray(pairs).view(np.complex64)[..., 0]

    def _blurred(
        self, power: np.ndarray, beams: float, range_m: float, border: int = cv2.BORDER_DEFAULT
    ) -> np.ndarray:
        """Power blurred by standard deviations across, in beams, and in range, m."""
        bins = min(max(range_m / self.bin_m, 0.3), len(power))
        blurred = cv2.GaussianBlur(power, (0, 0), sigmaX=beams, sigmaY=bins, borderType=border)
        return np.asarray(blurred)

    def _late(self, power: np.ndarray, time_s: float) -> np.ndarray | None:
        """(bins, beams) mean power of echoes by way of the surface: a later, blurred copy of the
        scene, and bands. None without. power: (bins, beams) of the direct echoes."""
        m = self._scene.multipath
        if max(m.copy_db, m.band_db) <= NO_ECHO_DB:
            return None
        drift = m.drift_m * np.sin(2 * np.pi * time_s / m.drift_s + self._phases)
        late: np.ndarray = np.zeros_like(power)
        if m.copy_db > NO_ECHO_DB:
            # A wider blur would look the same, but take longer.
            beams = min(max(m.blur_beams, 0.3), power.shape[1])
            rows = round((m.delay_m + drift[0]) / self.bin_m)
            copy = self._blurred(power, beams, m.blur_m, cv2.BORDER_REPLICATE)
            late = shifted(copy, rows) * np.float32(10 ** (m.copy_db / 10))
        if m.band_db > NO_ECHO_DB:
            further = min((self.range_m[-1] - m.band_m) / m.band_step_m, MOST_BANDS)
            number = np.arange(max(math.ceil(further) + 1, 1))
            middle = m.band_m + number * m.band_step_m + drift[1]
            band = np.exp(-0.5 * ((self.range_m[:, None] - middle) / m.band_width_m) ** 2)
            level = 10 ** ((m.band_db - 3 * number) / 10)
            late += (band @ level).astype(np.float32)[:, None]
        return late


def shifted(image: np.ndarray, rows: int) -> np.ndarray:
    """The image moved by this many rows to higher ones (lower if negative), filled with zeros."""
    moved, kept = np.zeros_like(image), max(len(image) - abs(rows), 0)
    moved[max(rows, 0) :][:kept] = image[max(-rows, 0) :][:kept]
    return moved


class Picture:
    """Turns the power of the beams into an 8-bit image: log compression, and the fan."""

    def __init__(self, scene: Scene, fan: Fan) -> None:
        self._picture = scene.picture
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        if scene.sonar.layout == "polar":
            return
        row, column = np.mgrid[0 : fan.rows, 0 : fan.columns]
        range_m, bearing_deg = polar_from_pixel(fan, column, row)
        bins, beams = scene.sonar.range_bins, scene.sonar.beams
        beam = np.interp(bearing_deg, scene_bearings(scene), np.arange(beams))
        bin_ = (range_m - fan.range_min_m) / (fan.range_max_m - fan.range_min_m) * bins - 0.5
        bin_ = np.clip(bin_, 0, bins - 1)
        self._maps = (beam.astype(np.float32), bin_.astype(np.float32))
        self._outside = ~in_fan(fan, range_m, bearing_deg)

    def __call__(self, power: np.ndarray) -> ByteImage:
        """The scene's image, uint8. power: (bins, beams), relative to the floor."""
        picture = self._picture
        grey = (10 / math.log(10)) * np.log(power + np.float32(1e-9)) - picture.black_db
        grey = np.clip(grey / picture.dynamic_range_db, 0, 1)
        if picture.gamma != 1:
            grey = grey**picture.gamma
        image = np.rint(grey * 255).astype(np.uint8)
        if self._maps is None:
            return image
        fan_image = cv2.remap(image, *self._maps, cv2.INTER_LINEAR)
        fan_image[self._outside] = 0
        return np.asarray(fan_image, dtype=np.uint8)
