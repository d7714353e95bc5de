"""Overlays of whole logs: stamped as their images, on the object, and they play."""

from __future__ import annotations

import base64
import gc
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.drawing.pen import disc_outline, landmark_colours
from sonarrec.overlays.overlay import overlay
from sonarrec.sonar.stated import Sonar, load_sonar
from tests.support.estimates import BASIN, csv_file, moving, noise, write_results
from tests.support.foxglove import messages, nanoseconds
from tests.support.logs import PERIOD_NS, SONAR_TOML, cdr_image, image_folder, mcap_file, read

STAMP_NS = 1_700_000_000_123_456_789


def test_annotations_carry_the_stamp_of_the_image(tmp_path: Path) -> None:
    """Header stamps that differ from the log times, as a recorder's always do."""
    stamps = [STAMP_NS + n * 249_999_999 for n in range(5)]
    logged = [stamp + 31_000_000 + n for n, stamp in enumerate(stamps)]
    recorded = [
        ("/sonar", log_time, cdr_image(image, stamp=divmod(stamp, 10**9)))
        for image, stamp, log_time in zip(noise(5), stamps, logged, strict=True)
    ]
    log = mcap_file(tmp_path / "log.mcap", recorded)
    overlay(log, tmp_path / "o.mcap", results=write_results(tmp_path / "results", moving(5)))
    # The images are in the recording already.
    for n, (name, time, message) in enumerate(messages(tmp_path / "o.mcap")):
        assert (name, time) == ("foxglove.ImageAnnotations", logged[n])
        assert message["texts"]  # never empty, or old versions hold the image back
        parts = [message, *message["points"], *message["texts"]]
        assert {nanoseconds(part["timestamp"]) for part in parts} == {stamps[n]}
    assert n == 4


def test_annotations_lie_on_the_object(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", noise(4))
    results = write_results(tmp_path / "results", moving(4))
    truth = csv_file(tmp_path / "gt.csv", "frame,landmark,x_px,y_px", "3,3,43,60")
    overlay(log, tmp_path / "o.mcap", results=results, ground_truth=truth)
    found = [m for name, _, m in messages(tmp_path / "o.mcap") if name.endswith("Annotations")]
    named, trail, other, dashes = (
        np.array([(p["x"], p["y"]) for p in part["points"]])
        for part in (found[3]["points"][k] for k in (0, 1, 2, 4))
    )
    # Foxglove's origin is the corner of the first pixel: half a pixel from its centre.
    fan = read(log).frames[0].fan
    np.testing.assert_allclose(named, disc_outline(fan, 0.15, 43.0, 60.0) + 0.5, atol=0.006)
    np.testing.assert_allclose(other.mean(axis=0), (70.5, 90.5), atol=1)
    np.testing.assert_allclose(trail, [[40.5, 60.5], [41.5, 60.5], [43.5, 60.5]])
    np.testing.assert_allclose(dashes.mean(axis=0), named.mean(axis=0), atol=0.2)
    kinds = [part["type"] for part in found[3]["points"]]
    assert kinds == [2, 3, 2, 3, 4]
    colour = found[3]["points"][0]["outline_color"]
    assert tuple(round(255 * colour[c]) for c in "rgb") == landmark_colours(BASIN.ids)[3]
    assert [t["text"] for t in found[3]["texts"]] == ["frame 3", "ID.3  0.90", "ID.3"]
    assert [t["text"] for t in found[2]["texts"]] == ["frame 2"]


def pictures(path: Path) -> list[tuple[int, int, np.ndarray]]:
    """Log time, stamp and pixels of the images in an overlay."""
    found = []
    for name, time, m in messages(path):
        if name == "foxglove.CompressedImage":
            png = np.frombuffer(base64.b64decode(m["data"]), np.uint8)
            image = np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED))
            found.append((time, nanoseconds(m["timestamp"]), image))
    return found


def test_polar_logs_bring_their_fan(tmp_path: Path) -> None:
    """As one MCAP for Foxglove that is itself a log of equal frames."""
    images = enumerate(noise(4, (100, 32)))
    recorded = [("/a", n * PERIOD_NS, cdr_image(image, stamp=(n, 5))) for n, image in images]
    log = mcap_file(tmp_path / "log.mcap", recorded)
    (tmp_path / "sonar.toml").write_text(SONAR_TOML.replace('"fan"', '"polar"'))
    overlay(log, tmp_path / "o.mcap", results=write_results(tmp_path / "results", moving(4)))
    frames = read(log).frames
    shown = pictures(tmp_path / "o.mcap")
    for n, (frame, (time, stamp, image)) in enumerate(zip(frames, shown, strict=True)):
        assert (time, stamp) == (n * PERIOD_NS, n * 10**9 + 5)
        np.testing.assert_array_equal(image, frame.image)
    fan = frames[0].fan
    apex = fan.apex_column, fan.apex_row
    stated = Sonar(layout="fan", metres_per_pixel=fan.metres_per_pixel, apex_px=apex)
    stated = load_sonar(tmp_path / "sonar.toml").updated(stated)
    again = read(tmp_path / "o.mcap", sonar=stated)
    assert all(frame.fan == fan for frame in again.frames)
    np.testing.assert_array_equal(again.images, [frame.image for frame in frames])


def test_the_log_is_read_as_the_run_read_it(tmp_path: Path) -> None:
    """Topic, clock and geometry of run.toml; a flipped log is shown by the overlay's own images."""
    stored = [
        (topic, n * PERIOD_NS, cdr_image(image + shade, stamp=(n, 0)))
        for n, image in enumerate(noise(3))
        for topic, shade in (("/a", 0), ("/b", 100))
    ]
    log = mcap_file(tmp_path / "log.mcap", stored)
    sonar = load_sonar(tmp_path / "sonar.toml").updated(Sonar(flip=True))
    run = {"input": {"topic": "/b", "time": "header"}, "sonar": sonar.as_table()}
    (tmp_path / "sonar.toml").unlink()
    results = write_results(tmp_path / "results", moving(3), run)
    o = tmp_path / "o.mcap"
    assert not overlay(log, o, results=results).diagnostics.notes
    for (_, _, shown), image in zip(pictures(o), noise(3), strict=True):
        np.testing.assert_array_equal(shown, image[:, ::-1] + 100)
    other = overlay(log, tmp_path / "a.mcap", results=results, topic="/a")
    (note,) = other.diagnostics.notes
    assert str(results) in note


def test_video_and_images(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", noise(6, (131, 97)))
    results = write_results(tmp_path / "results", moving(6))
    video, images = tmp_path / "o.mp4", tmp_path / "shots"
    overlay(log, video, results=results, frames=(1, 5))
    done = overlay(log, images, results=results, frames=(1, 5))
    assert (done.method, done.frames) == ("framework", 4)
    assert done.diagnostics.problems == []
    assert sorted(p.name for p in images.iterdir()) == [f"{n:06d}.png" for n in range(1, 5)]
    player = cv2.VideoCapture(str(video))
    assert player.get(cv2.CAP_PROP_FPS) == 4
    for n in range(1, 5):
        ok, played = player.read()
        assert ok
        picture = cv2.imread(str(images / f"{n:06d}.png"))
        assert picture is not None
        assert picture.shape == played.shape == (664, 512, 3)
        # The codec loses some of the speckle, not the drawing.
        assert np.abs(played.astype(int) - picture).mean() < 6
    assert not player.read()[0]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """The index of the file grows by a hundred bytes a frame. Were the images of 200 more kept,
    these would be 600 kB."""

    def peak(count: int) -> int:
        folder = tmp_path / str(count)
        log = image_folder(folder / "log", noise(count, (64, 48)))
        results = write_results(folder / "results", moving(count))
        done = at_first = 0

        def observe(_: int | None) -> None:
            nonlocal done, at_first
            done += 1
            if done == 1:  # what is read before the frames takes more than all of them
                tracemalloc.reset_peak()
                # Python's own tables grow by megabytes at some time, after other tests in this one.
                at_first = tracemalloc.get_traced_memory()[0]

        gc.collect()  # what other tests left is not to be freed in between
        tracemalloc.start()
        overlay(log, folder / "o.mcap", results=results, observe=observe)
        found = tracemalloc.get_traced_memory()[1] - at_first
        tracemalloc.stop()
        assert done == count
        return found

    peak(5)  # imports
    # With fewer frames the first chunk of the file, and of estimates.csv, is not full yet.
    assert peak(1440) - peak(1240) < 200_000
