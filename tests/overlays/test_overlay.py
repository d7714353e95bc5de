"""Overlays: stamped as their images, on the object, playable; what the command refuses."""

from __future__ import annotations

import base64
import gc
import re
import shutil
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result

from sonarrec.drawing.pen import disc_outline, landmark_colours
from sonarrec.overlays.overlay import overlay
from sonarrec.readers import open_log
from sonarrec.sonar.stated import Sonar, load_sonar
from tests.support import command
from tests.support.camp import make_camp
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


# The command


def draw(*arguments: str | Path, code: int = 0) -> Result:
    result = command.sonarrec("overlay", *arguments, code=code)
    assert (code == 0) == (result.stderr == "")
    return result


def names(folder: Path | str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


def set_run(before: str, after: str) -> Path:
    """Change the run.toml of the results; returns it."""
    run = Path("sonarrec_out/log/run.toml")
    text = run.read_text()
    assert before in text
    run.write_text(text.replace(before, after))
    return run


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a log, `log`, and what `sonarrec run` would leave of it."""
    monkeypatch.chdir(tmp_path)
    image_folder(tmp_path / "log", noise(4))
    with open_log("log") as log:
        size, sha256 = log.digest_source()
        sonar = log.sonar.as_table()
    run = {
        "input": {"name": "log", "bytes": size, "sha256": sha256},
        "sonar": sonar,
        "landmarks": BASIN.as_table(),
    }
    write_results(tmp_path / "sonarrec_out" / "log", moving(4), run)
    return tmp_path


@pytest.mark.usefixtures("work")
def test_the_command() -> None:
    Path("log/sonar.toml").unlink()  # run.toml tells the geometry
    for out in ("o.mcap", "o.mp4", "shots"):
        assert draw("log", "-o", out).stdout == f"{out}: 4 frames, framework\n"
    assert Path("o.mp4").is_file()
    assert len(list(messages(Path("o.mcap")))) == 8
    assert len(names("shots")) == 4
    draw("log", "sonarrec_out/log", "-o", "one", "--frames", "2:3", "-q")
    assert names("one") == ["000002.png"]
    one, other = (Path(folder, "000002.png").read_bytes() for folder in ("one", "shots"))
    assert one == other  # what came before is in its strip all the same


@pytest.mark.usefixtures("work")
def test_a_list_of_frames() -> None:
    draw("log", "-o", "some", "--frames", "0:2, 3", "-q")
    assert names("some") == ["000000.png", "000001.png", "000003.png"]
    assert "40:41" in draw("log", "-o", "one", "--frames", "2,40", code=3).stderr
    assert names("one") == ["000002.png"]
    overlay("log", "python", frames=[(0, 1), (3, None)])
    assert len(names("python")) == 2


def test_results_find_their_log(work: Path) -> None:
    results = work / "sonarrec_out" / "log"
    assert "not found" in draw(results, "-o", "x", code=2).stderr
    set_run("[input]", '[input]\npath = "log"')
    draw("log", "-o", "given", "-q")
    draw(results, "-o", "found", "-q")
    shutil.copytree(results, work / "sonarrec_out" / "copy")
    assert "copy: 4 frames" in draw("sonarrec_out", "-o", "each").stdout
    drawn = [
        {name: (work / folder / name).read_bytes() for name in names(folder)}
        for folder in ("given", "found", "each/log", "each/copy")
    ]
    assert drawn == drawn[:1] * 4
    assert "hold results" in draw(results, "sonarrec_out/copy", "-o", "x", code=2).stderr
    assert "log first" in draw(results, "log", "-o", "x", code=2).stderr


def test_the_longest_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ID.1 is declared from frame 1 on; it shall be ID.2 in 5 to 7, and is no mistake in frame 0,
    where no track is declared."""
    monkeypatch.chdir(tmp_path)
    truth = make_camp(tmp_path / "camp", 1, 14, trouble=False) / "dive01" / "gt.csv"
    # At 0.85 a blank disc is taken for ID.1 in one frame.
    command.sonarrec("run", "camp/dive01", "-q", "--set", "features.declare=0.9")
    nothing = draw("camp/dive01", "-o", "wrong", "--mistakes", "9").stdout
    assert nothing.startswith("framework: no mistake")
    wrong = re.sub("^([567]),1,", r"\1,2,", truth.read_text(), flags=re.MULTILINE)
    truth.write_text(wrong)
    by_log = draw("camp/dive01", "-o", "wrong", "--mistakes", "9").stdout
    head, *told = by_log.splitlines()
    [(worst, _), _] = shown = [re.fullmatch(r"  frame (\d): (.*)", line).groups() for line in told]
    assert {re.sub(r"[01]\.\d\d", "#", what) for _, what in shown} == {
        "ID.1 declared (#) on what is ID.2; 3 of frames 5 to 7",
        "ID.2 in view and not declared: best guess ID.1 (#); 3 of frames 5 to 7",
    }
    assert head == "wrong: 1 frame, framework"
    assert names("wrong") == [f"00000{worst}.png"]
    for results in ("sonarrec_out", "sonarrec_out/dive01"):
        found = draw(results, "-o", "wrong", "--mistakes", "1").stdout
        assert found.splitlines() == [head, told[0]]
    both = draw("sonarrec_out", "-o", "x", "--mistakes", "1", "--frames", "1:", code=2)
    assert "--frames" in both.stderr


@pytest.mark.usefixtures("work")
def test_the_frames_drawn_are_those_that_were_run() -> None:
    """Nobody looked at the others: an empty picture of them would say that nothing is there."""
    set_run("[input]", '[input]\nframes = "1:3"')
    draw("log", "-o", "shots", "-q")
    assert names("shots") == ["000001.png", "000002.png"]
    draw("log", "-o", "all", "--frames", "0:", "-q")
    assert len(names("all")) == 4


@pytest.mark.usefixtures("work")
def test_a_run_that_was_cut_short() -> None:
    run = set_run("finished = true", "finished = false")
    assert "frames after 3" in draw("log", "-o", "o.mcap", code=3).stderr
    # As a run leaves it that was stopped.
    run.parent.rename(run.parent.with_name("log.part"))
    for results in ([], ["sonarrec_out/log"]):
        told = draw("log", *results, "-o", "o.mcap", code=3).stderr
        assert re.search("log.part: .*frames after 3", told)


@pytest.mark.parametrize(
    ("arguments", "code", "fault"),
    [
        ("-o paper.csv/o.mp4", 2, "paper.csv is not a folder"),
        ("-o log", 2, "become a part"),
        ("-o o.mcap --frames 3:3", 2, "from 3 "),
        ("-o o.mcap --frames 9:", 2, "--frames 9:"),
        ("-o o.mcap --frames 2,all", 2, "A:B"),
        ("-o o.mcap --method x", 2, "'x'; there is framework"),
        ("elsewhere -o o.mcap", 2, "elsewhere: no results"),
        ("-o o.mcap --ground-truth paper.csv", 1, "paper.csv: no positions"),
    ],
)
def test_faults_are_one_line(arguments: str, code: int, fault: str, work: Path) -> None:
    csv_file(work / "paper.csv", "frame,landmark", "0,3")
    told = draw("log", *arguments.split(), code=code)
    (line,) = told.stderr.splitlines()
    assert fault in line
    assert not told.stdout


def test_truth_of_another_log_is_told(work: Path) -> None:
    csv_file(work / "gt.csv", "log,frame,landmark,x_px,y_px", "dive,3,3,43,60")
    (line,) = draw("log", "-o", "o", "--ground-truth", "gt.csv", code=3).stderr.splitlines()
    assert line.startswith("sonarrec: gt.csv")


def test_results_of_another_log(work: Path) -> None:
    cv2.imwrite(str(work / "log" / "frame0.png"), noise(1)[0] + 1)
    (line,) = draw("log", "-o", "o.mcap", code=1).stderr.splitlines()
    assert "another log" in line
