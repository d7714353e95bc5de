"""Logs of polar pings: their windows, sides and orders, what the user states, and every time."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.readers import open_log
from sonarrec.readers.decode.layout import Stated
from sonarrec.readers.decode.reading import apply, settle
from sonarrec.readers.info import describe
from sonarrec.readers.raw import PingGeometry, StoredFrame
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import PolarToFan, polar_from_pixel
from sonarrec.sonar.stated import Sonar
from tests.support import messages
from tests.support.command import sonarrec
from tests.support.logs import PERIOD_NS, Read, frames, image_folder, mcap_file, read
from tests.support.messages import BEAMS, BIN_M, BINS, TILT, log_of, polar_frames, stamp_ns
from tests.support.rows import read_rows

BEARINGS = tuple(np.linspace(-14, 14, polar_frames(1)[0].shape[1]).tolist())


def projected(count: int = 3) -> list[dict[str, Any]]:
    return [messages.projected_fields(k, image) for k, image in enumerate(polar_frames(count))]


def read_pings(
    folder: Path, pings: list[dict[str, Any]], sonar: Sonar = TILT, **options: Any
) -> Read:
    return read(log_of(folder / "log.mcap", pings), sonar=sonar, **options)


def places(fan: Fan) -> tuple[np.ndarray, np.ndarray]:
    """Range (m) and bearing (deg) of each pixel of a fan."""
    row, column = np.mgrid[0 : fan.rows, 0 : fan.columns]
    return polar_from_pixel(fan, column, row)


def test_uneven_ranges(tmp_path: Path) -> None:
    """Bins that grow with range: each pixel of the fan shows the bin at its own range."""
    middles = 1 + 0.9 * np.linspace(0, 1, BINS) ** 1.5
    image = np.repeat(np.arange(10, 10 + BINS, dtype=np.uint8)[:, None], BEAMS, axis=1)
    fields = messages.projected_fields(0, image) | {"ranges": middles.astype(np.float32)}
    (frame,) = read_pings(tmp_path, [fields]).frames
    range_m, _ = places(frame.fan)
    expected = np.interp(range_m, middles, np.arange(10, 10 + BINS))
    seen = frame.image > 0
    assert seen.mean() > 0.3
    # cv2.remap places to a 32nd of a bin, and pixels are whole numbers.
    assert np.abs(frame.image[seen] - expected[seen]).max() <= 0.5 + 1 / 32 + 0.01


def test_the_tilt_is_the_users(tmp_path: Path) -> None:
    path = log_of(tmp_path / "log.mcap", projected(1))
    with pytest.raises(SonarrecError, match="--tilt-deg"):
        read(path)
    (frame,), problems, notes = read(path, sonar=Sonar(tilt_deg=12.0, height_m=0.3))
    assert (frame.fan.tilt_deg, frame.fan.height_m) == (12.0, 0.3)
    assert not problems + notes
    (frame,), problems, _ = read(path, sonar=Sonar(height_m=0.3))
    assert (frame.fan.height_m, problems) == (0.3, [])


def test_a_window_that_changes(tmp_path: Path) -> None:
    """A ping of another window is put where it belongs in the fan of the first; one that shows
    too little of it is told of."""
    image = polar_frames(1)[0]
    pings = []
    for first, length, bins in ((1.0, 1.0, 60), (0.5, 2.0, 90), (1.25, 1.0, 60), (1.6, 1.0, 60)):
        grey = np.full((bins, BEAMS), 200, np.uint8) if pings else image
        middles = first + (np.arange(bins) + 0.5) * length / bins
        fields = messages.projected_fields(len(pings), grey)
        pings.append(fields | {"ranges": middles.astype(np.float32)})
    found = read_pings(tmp_path, pings)
    assert found.numbers == [0, 1, 2]
    (problem,) = found.problems
    assert "1.6 to 2.6 m" in problem
    fan = found.frames[0].fan
    assert all(f.fan == fan for f in found.frames)
    assert fan.range_min_m == pytest.approx(1.0)
    range_m, bearing = places(fan)
    inside = (np.abs(range_m - 1.5) < 0.49) & (np.abs(bearing) < 15)
    _, second, third = found.images
    assert (second[inside] == 200).all()
    assert (third[inside & (range_m > 1.26)] == 200).all()
    assert (third[range_m < 1.24] == 0).all()


def test_an_odd_first_ping_does_not_settle_the_window(tmp_path: Path) -> None:
    """Sent before the driver had its settings: ten times as far, or nowhere near."""
    for kept in ([0, 1, 2, 3], [1, 2, 3]):
        pings = projected(4)
        near = (pings[0]["ranges"] / 10).astype(np.float32)
        # From the sonar on, so that it shows what the others do.
        far = (np.arange(BINS) + 0.5).astype(np.float32) / 4
        pings[0]["ranges"] = far if kept[0] == 0 else near
        found = read_pings(tmp_path, pings)
        assert found.numbers == kept
        assert len(found.problems) == 4 - len(kept)
        assert found.frames[0].fan.range_max_m == pytest.approx((messages.FIRST_BIN + BINS) * BIN_M)


def test_what_is_stated_does_not_fit_the_log(tmp_path: Path) -> None:
    path = log_of(tmp_path / "log.mcap", projected(1))
    with pytest.raises(SonarrecError, match=f"^{re.escape(str(path))}: bearings_deg .* 2 .* 24 "):
        read(path, sonar=TILT.updated(Sonar(bearings_deg=(-1.0, 1.0))))
    with pytest.raises(SonarrecError, match="height_m = 3"):
        read(path, sonar=TILT.updated(Sonar(height_m=3.0)))


def test_the_number_of_even_bins_may_change(tmp_path: Path) -> None:
    """In the same window: the message tells nothing else anew, yet its bins are longer."""
    image = np.zeros((64, BEAMS), np.uint8)
    image[32:] = 200
    pings = []
    for bins in (64, 32, 128, 64):
        grey = cv2.resize(image, (BEAMS, bins), interpolation=cv2.INTER_NEAREST)
        fields = messages.oculus_interfaces_fields(len(pings), grey)
        pings.append(fields | {"range_resolution": BIN_M * 64 / bins})
    found = read(log_of(tmp_path / "log.mcap", pings, messages.OCULUS), sonar=TILT)
    assert not found.problems
    far = 64 * BIN_M
    for frame in found.frames:
        range_m, bearing = places(frame.fan)
        seen = np.abs(bearing) < 12
        assert (frame.image[seen & (range_m > 0.54 * far) & (range_m < 0.99 * far)] == 200).all()
        assert (frame.image[seen & (range_m < 0.46 * far)] == 0).all()


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        (Sonar(range_min_m=0.9), "range_min_m = 0.9 (not 1)"),
        (Sonar(range_max_m=2.5), "range_max_m = 2.5 (not 1.938)"),
        (Sonar(field_of_view_deg=60.0), "field_of_view_deg = 60 (not 33.39)"),
        (Sonar(layout="fan"), 'layout = "fan" (they are polar, and read so)'),
        (Sonar(bearings_deg=tuple(range(-12, 12))), "bearings_deg"),
        (Sonar(range_min_m=1.001, field_of_view_deg=33.0), None),
        (Sonar(layout="polar", bearings_deg=None), None),
    ],
)
def test_what_is_stated_wins_and_is_told(stated: Sonar, says: str | None, tmp_path: Path) -> None:
    found, problems, notes = read_pings(tmp_path, projected(), stated.updated(TILT))
    assert not problems
    assert [note.rpartition("messages: ")[2] for note in notes] == ([] if says is None else [says])
    fan = found[0].fan
    assert stated.range_min_m in (None, fan.range_min_m)
    assert stated.range_max_m in (None, fan.range_max_m)
    if stated.field_of_view_deg == 60:
        assert fan.bearing_max_deg == 30
    if stated.bearings_deg is not None:
        assert fan.bearing_min_deg == -12.5


def beam_major(fields: dict[str, Any]) -> dict[str, Any]:
    image = fields["image"]
    data = np.ascontiguousarray(image["data"].reshape(BINS, BEAMS).T).ravel()
    return fields | {"image": image | {"data": data}}


def test_beam_order(tmp_path: Path) -> None:
    pings = projected()
    expected = read_pings(tmp_path, pings).images
    other = log_of(tmp_path / "other.mcap", [beam_major(fields) for fields in pings])
    with open_log(other, sonar=TILT) as log:
        np.testing.assert_array_equal([frame.image for frame in log], expected)
        assert log.reading()["beam_order"] == "beam-major"
        (note,) = log.diagnostics.notes
        assert f"{other}: read" in note
    wrong, stated = (
        read(other, sonar=Sonar(tilt_deg=20.0, beam_order=order)).images
        for order in ("range-major", "beam-major")
    )
    np.testing.assert_array_equal(stated, expected)
    assert not any(np.array_equal(*both) for both in zip(wrong, expected, strict=True))


def test_blank_pings_settle_nothing(tmp_path: Path) -> None:
    """Neither the fan, where their window is another, nor the height."""
    pings = projected(9)
    expected = read_pings(tmp_path, pings)
    for fields in pings[:6]:
        fields["image"] = fields["image"] | {"data": np.zeros(BINS * BEAMS, np.uint8)}
        fields["ranges"] = fields["ranges"] * 0.95
    found = read_pings(tmp_path, pings)
    assert [f.fan for f in found.frames] == [f.fan for f in expected.frames]
    assert [bool(image.any()) for image in found.images] == [k >= 6 for k in range(9)]


@pytest.mark.parametrize("stated", [None, "range-major"])
def test_beam_order_of_as_many_bins_as_beams_is_assumed(tmp_path: Path, stated: Any) -> None:
    pings = []
    for k, image in enumerate(polar_frames()):
        fields = messages.projected_fields(k, np.ascontiguousarray(image[:BEAMS]))
        pings.append(fields | {"ranges": fields["ranges"][:BEAMS]})
    path = log_of(tmp_path / "log.mcap", pings)
    sonar = Sonar(tilt_deg=20.0, beam_order=stated)
    with open_log(path, sonar=sonar) as log:
        list(log)
        assert log.reading()["beam_order"] == "range-major"
        told = [f"{path}: assumed to be range-major: its {BEAMS} range bins"] if not stated else []
        assert [note.partition(" are")[0] for note in log.diagnostics.notes] == told
    (images,) = describe(path, sonar=sonar).images
    assert images.origins["beam_order"] == ("flag" if stated else "assumed")


def test_polar_images_with_a_row_per_beam(tmp_path: Path) -> None:
    images = frames(3, BINS, BEAMS)
    folder = image_folder(tmp_path / "usual", images)
    turned = image_folder(tmp_path / "turned", [np.ascontiguousarray(i.T) for i in images])
    polar = Sonar(layout="polar")
    found = read(turned, sonar=polar.updated(Sonar(beam_order="beam-major")))
    np.testing.assert_array_equal(found.images, read(folder, sonar=polar).images)


@pytest.mark.parametrize("uneven", [False, True])
def test_flip_mirrors_the_bearings(uneven: bool, tmp_path: Path) -> None:
    """What lay at bearing b lies at -b, also where bearings are neither even nor symmetric."""
    sonar = Sonar(range_min_m=1.0, range_max_m=1.9, field_of_view_deg=28.0, tilt_deg=20.0)
    if uneven:
        sonar = sonar.updated(Sonar(bearings_deg=tuple((messages.BEARINGS_DEG + 2).tolist())))
    spot = np.zeros((BINS, BEAMS), np.uint8)
    spot[28:33, 17:21] = 255
    centres = []
    for flip in (False, True):
        to_fan = PolarToFan(sonar.updated(Sonar(flip=flip)).complete("test"), BINS, BEAMS)
        image = to_fan(spot).astype(float)
        row, column = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
        centre = (image * column).sum() / image.sum(), (image * row).sum() / image.sum()
        centres.append([float(v) for v in polar_from_pixel(to_fan.fan, *centre)])
        assert to_fan.fan.bearing_min_deg < to_fan.fan.bearing_max_deg
    assert abs(centres[0][1]) > 3
    np.testing.assert_allclose(centres[1], [centres[0][0], -centres[0][1]], atol=1e-6)
    folder = image_folder(tmp_path / "fan", frames(2))
    found = read(folder, sonar=Sonar(flip=True)).images
    np.testing.assert_array_equal(found, np.array(frames(2))[:, :, ::-1])


# Times


def test_the_time_that_names_a_frame(tmp_path: Path) -> None:
    """Header stamps that go back: they name the frames, log time orders them."""
    path = tmp_path / "log.mcap"
    images = polar_frames(4)
    pings = [
        (
            "/a",
            k * PERIOD_NS,
            messages.serialised("sensor_msgs/msg/Image", messages.image_fields(3 - k, i)),
        )
        for k, i in enumerate(images)
    ]
    mcap_file(path, pings)
    expected = {
        "log": [k * PERIOD_NS for k in range(4)],
        "publish": [k * PERIOD_NS + 1 for k in range(4)],
        "header": [stamp_ns(3 - k) for k in range(4)],
    }
    for clock, times in expected.items():
        found = read(path, time=clock)
        assert not found.problems
        assert found.times == times
        np.testing.assert_array_equal(found.images, images)
    sonarrec("run", path, "--time", "header", "-o", tmp_path)
    row = read_rows(tmp_path / "log" / "frames.csv")[1]
    times = {"log_time_ns": PERIOD_NS, "publish_time_ns": PERIOD_NS + 1}
    times |= dict.fromkeys(("header_stamp_ns", "timestamp_ns"), stamp_ns(2))
    assert row.items() >= {name: str(time) for name, time in times.items()}.items()
    again = tmp_path / "again"
    sonarrec("run", path, "--config", tmp_path / "log" / "run.toml", "-o", again)
    tables = [(out / "log" / "estimates.csv").read_bytes() for out in (tmp_path, again)]
    assert tables[0] == tables[1]


def test_a_message_without_a_stamp(tmp_path: Path) -> None:
    message = b'{"height": 2, "width": 3, "encoding": "mono8", "data": "AAAAAAAA"}'
    path = mcap_file(tmp_path / "log.mcap", [("/a", 0, message)], schema="foxglove.RawImage",
                     encoding="json")  # fmt: skip
    assert read(path).frames[0].stamps.header is None
    with pytest.raises(SonarrecError, match="--time log"):
        read(path, time="header")
    with pytest.raises(UsageError, match="publish, header"):
        read(path, time="sonar")
    with pytest.raises(UsageError, match="--time"):
        open_log(image_folder(tmp_path / "images", frames(1)), time="header")


def test_header_stamps_that_nobody_set(tmp_path: Path) -> None:
    """Many drivers leave them 0: log times serve, and a note says so. One that a simulator's clock
    began at 0 is a time."""
    unset = {"header": {"seq": 0, "stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}}
    pings, bare = projected(), [ping | unset for ping in projected()]
    found = read_pings(tmp_path, bare, time="header")
    assert found.times == [0, PERIOD_NS, 2 * PERIOD_NS]
    [note] = found.notes
    assert "instead" in note
    found = read_pings(tmp_path, [*bare[:1], *pings[1:]], time="header")
    assert found.times == [0, stamp_ns(1), stamp_ns(2)]
    [note] = found.notes
    assert "jump ahead" in note
    lapse = [*pings[:2], bare[2]]
    found = read_pings(tmp_path, lapse, time="header")
    assert found.times == [stamp_ns(0), stamp_ns(1)]
    [problem] = found.problems
    assert "message 2 of /a" in problem
    assert len(read_pings(tmp_path, lapse).frames) == 3


@pytest.mark.parametrize(
    ("axis", "angle_deg"), [("z", 0.0), ("z", 40.0), ("z", -25.0), ("y", 30.0), ("y", -20.0)]
)
def test_beams_of_a_mounting_that_leans(axis: str, angle_deg: float, tmp_path: Path) -> None:
    """Bearings are taken in the beams' own plane, whose pitch is noted."""
    (flat,), (leaning,) = projected(1), projected(1)
    angle = np.radians(angle_deg)
    leaning["beam_directions"] = [
        one | {"x": one[axis] * np.sin(angle), axis: one[axis] * np.cos(angle)}
        for one in flat["beam_directions"]
    ]
    (expected,), _, _ = read_pings(tmp_path, [flat])
    (frame,), _, notes = read_pings(tmp_path, [leaning])
    for edge in ("bearing_min_deg", "bearing_max_deg"):
        assert getattr(frame.fan, edge) == pytest.approx(getattr(expected.fan, edge), abs=1e-3)
    if axis == "z":
        assert any("pitched" in note for note in notes) == (angle_deg != 0)


# How a log is read is decided once: `settle` and `apply` keep nothing between two calls


def ping(name: str, image: np.ndarray, near_m: float = 1.0) -> StoredFrame:
    return StoredFrame(name, 0, image, ping=PingGeometry(near_m, near_m + 1, BEARINGS, None))


def test_apply_gives_the_same_for_the_same() -> None:
    """Also after other frames, of another window, of another type, or unlike all others."""
    notes: list[str] = []
    stated = Stated(Sonar(tilt_deg=20.0), "log", "messages", notes.append)
    images = polar_frames(3)
    first = [ping(str(n), image) for n, image in enumerate(images)]
    reading = settle(stated, first)
    assert reading.layout is not None
    assert settle(stated, first).levels == reading.levels
    before = [apply(reading, frame)[1] for frame in first]
    moved, shown = apply(reading, ping("moved", images[0], 1.25))
    assert moved.layout is not None
    assert moved.fan == reading.fan
    assert moved.layout.polar is not reading.layout.polar
    deep = images[0].astype(np.uint16) * 257
    assert set(apply(reading, ping("deep", deep))[0].levels.scales) == {
        np.dtype(np.uint8), np.dtype(np.uint16),
    }  # fmt: skip
    assert set(reading.levels.scales) == {np.dtype(np.uint8)}
    for frame, image in zip(first, before, strict=True):
        same, again = apply(reading, frame)
        assert same == reading
        np.testing.assert_array_equal(again, image)
    np.testing.assert_array_equal(shown, before[0])  # polar pixels are as they came
