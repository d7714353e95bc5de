"""What messages promise: a command that is named runs as it is, shows what it is said to show,
loses nothing, and was not tried just now."""

from __future__ import annotations

import math
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result

from sonarrec.landmarks import load_landmarks
from sonarrec.readers import open_log
from sonarrec.recogniser.ring_sizes import RingSizes
from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.rows import read_rows, write_rows
from tests.support.slow import but_first

SAMPLES = SAMPLE.parent
DATA = SAMPLE.parents[2] / "shared" / "data"
Row = dict[str, str]


def commands(told: str) -> list[list[str]]:
    """The words of the commands that a text names, as a shell would split them."""
    named = re.findall(r"`sonarrec ([^`]*)`", told)
    return [shlex.split(words) for words in dict.fromkeys(named)]


def contents(*folders: Path) -> dict[Path, bytes]:
    return {f: f.read_bytes() for one in folders for f in sorted(one.rglob("*")) if f.is_file()}


def run_named(told: str, *kept: Path, code: int = 0) -> list[Result]:
    """Run each command that a text names. kept: folders whose files stay as they are."""
    before = contents(*kept)
    assert before or not kept
    done = [sonarrec(*words, code=code) for words in commands(told)]
    assert done
    after = contents(*kept)
    assert {file: after.get(file) for file in before} == before
    return done


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def nothing_in(image: Path) -> None:
    """Make an image in which there is nothing to recognise."""
    shape = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE).shape  # type: ignore[union-attr]
    cv2.imwrite(str(image), np.full(shape, 20, np.uint8))


def changed(path: Path, source: Path, change: Callable[[Row], Row]) -> Path:
    """A gt.csv whose rows are changed."""
    write_rows(path, [change(row) for row in read_rows(source)])
    return path


def evaluated(pan: Path, truth: Path, *more: str, code: int = 0) -> Result:
    return sonarrec("evaluate", pan, "--ground-truth", truth, "-o", "ev", *more, code=code)


ORDERS = ("near_first", "far_first")


@pytest.mark.parametrize(
    ("folder", "tried", "offered"), [("pan", *ORDERS), ("polar", *ORDERS[::-1])]
)
def test_the_range_order_that_was_tried_is_not_offered(
    folder: str, tried: str, offered: str
) -> None:
    log = Path("my dives") / f"{folder} 'a'"
    log.mkdir(parents=True)
    shutil.copy(SAMPLES / folder / "sonar.toml", log)
    for name in ("000040.png", "000041.png"):
        nothing_in(Path(shutil.copy(SAMPLES / folder / name, log)))
    out = Path("my results")
    told = sonarrec("run", log, "-o", out, "--range-order", tried, "-q").stderr
    assert f"--range-order {offered}" in told
    assert f"--range-order {tried}" not in told
    again = [words for words in commands(told) if words[0] == "run"]
    assert len({words[-1] for words in again}) == len(again) == 2  # none replaces another's results
    run_named(told, out / log.name)


def test_a_fan_turned_by_mistake_is_told_to_be_turned_back(here: Path) -> None:
    log = sample_log(here / "log", 8)
    with (log / "sonar.toml").open("a") as file:
        file.write('range_order = "near_first"\n')
    told = sonarrec("run", log, "-q").stderr
    assert "down: try --range-order far_first" in told
    (preview,) = [words for words in commands(told) if "--preview" in words][:1]
    done = sonarrec(*preview)
    assert Path(preview[-1]).read_bytes()[:4] == b"\x89PNG"
    assert preview[-1] in done.stderr  # it says what it wrote
    turned = sonarrec("run", log, "-q", "--range-order", "far_first", "-o", "turned").stderr
    assert "upside down" not in turned


def test_the_geometry_of_flags_and_the_poses_go_into_the_command(here: Path) -> None:
    """Without them the command would fail, or give something else."""
    log = sample_log(here / "log", 3)
    (log / "sonar.toml").unlink()
    for image in log.glob("*.png"):
        nothing_in(image)
    Path("poses.csv").write_text("timestamp,yaw,x,y\n0,0,0,0\n1,0,0,0\n2,0,0,0\n")
    stated = {"range-min-m": 1.25, "range-max-m": 3.75, "field-of-view-deg": 28.8, "tilt-deg": 20}
    flags = [word for key, value in stated.items() for word in (f"--{key}", str(value))]
    told = sonarrec("run", log, *flags, "--odometry", "poses.csv", "-q", "-o", "out").stderr
    assert "no landmark declared" in told
    run_named(told, Path("out"))


def test_a_log_without_geometry_is_told_the_command_that_begins_one(here: Path) -> None:
    log = here / "my log.mcap"
    shutil.copy(SAMPLES / "pan.mcap", log)
    told = sonarrec("run", log, code=1).stderr
    run_named(told, log.parent)
    written = here / "my log.sonar.toml"
    assert "missing" in written.read_text()
    again = sonarrec("run", log, code=1).stderr  # now it is there, and to be completed
    assert f"{written}: sonar geometry" in again
    assert commands(again) == []


def test_rows_outside_the_image_are_named_and_checked_alike(here: Path, pan: Path) -> None:
    def far(row: Row) -> Row:
        return polar(row) | ({"range_m": "9"} if row["frame"] in ("5", "7") else {})

    truth = changed(here / "my truth.csv", SAMPLES / "pan.gt.csv", far)
    told = evaluated(pan, truth).stdout
    (note,) = [line for line in told.splitlines() if "outside the image" in line]
    assert "2 of 199 positions" in note
    assert "frames 5, 7" in note
    (checked,) = run_named(note, pan, code=3)
    assert checked.stdout.count("whole disc") == 2


@pytest.mark.slow
def test_a_disc_that_an_edge_only_just_cuts_off_is_no_fault() -> None:
    """The truth of a simulation: evaluate counted rows as outside that check found no fault in."""
    sonarrec("simulate", "--scene", "paper", "--seed", "1", "--frames", "248", "-q", "-o", "sim")
    assert "no fault" in sonarrec("truth", "check", "sim/gt.csv", "sim").stdout
    frames = "frame\n" + "".join(f"{n}\n" for n in range(248))
    Path("out").mkdir()
    Path("out/frames.csv").write_text(frames)
    Path("out/estimates.csv").write_text(
        "frame,method,range_m,bearing_deg,landmark,score,declared\n0,m,2,0,1,0.5,0\n"
    )
    scored = ("evaluate", "out", "--ground-truth", "sim/gt.csv", "--sonar", "sim/sonar.toml")
    assert "outside the image" not in sonarrec(*scored).output


@pytest.mark.parametrize(
    ("named", "meant"),
    [
        ("x,y", "x_px,y_px"),
        ("X_PX,Y_PX", "x_px,y_px"),
        ("range,bearing", "range_m,bearing_deg"),
        ("u,v", "u,v"),
    ],
)
def test_columns_that_are_not_read_are_named(here: Path, pan: Path, named: str, meant: str) -> None:
    truth = here / "gt.csv"
    rows = (f"{n},1,{100 + n},{180 - n}" for n in range(20))
    truth.write_text("\n".join([f"frame,landmark,{named}", *rows]))
    done = evaluated(pan, truth, code=3)
    assert "strict protocol" in done.stdout  # is left out
    checked = sonarrec("truth", "check", truth, SAMPLE, code=3).stdout
    for text in (done.stderr, checked):
        (line,) = [line for line in text.splitlines() if "not read" in line]
        assert all(re.search(rf"\b{name}\b", line) for name in f"{named},{meant}".split(","))


def test_columns_of_the_user_s_own_are_no_fault(here: Path, pan: Path) -> None:
    def noted(row: Row) -> Row:
        return {**row, "comment": "seen", "time": "12:00", "x": "1"}  # positions are there

    truth = changed(here / "gt.csv", SAMPLES / "pan.gt.csv", noted)
    assert evaluated(pan, truth).stderr == ""
    assert "no fault" in sonarrec("truth", "check", truth, SAMPLE).stdout


def polar(row: Row) -> Row:
    return {key: row[key] for key in ("frame", "landmark", "range_m", "bearing_deg", "visible")}


def moved(row: Row, frames: int) -> Row:
    return {**polar(row), "frame": str(int(row["frame"]) + frames)}


def radians(row: Row) -> Row:
    return {**polar(row), "bearing_deg": f"{-math.radians(float(row['bearing_deg'])):.6f}"}


def swung(row: Row) -> Row:
    """As from north, while the sonar turned by 8 deg to and fro."""
    bearing_deg = float(row["bearing_deg"])
    return {**polar(row), "bearing_deg": f"{bearing_deg - math.copysign(8, bearing_deg):.4f}"}


def mirrored(row: Row) -> Row:
    return {**polar(row), "bearing_deg": f"{-float(row['bearing_deg']):.4f}"}


def far_end(row: Row) -> Row:  # the log shows 1.25 to 3.75 m
    return {**mirrored(row), "range_m": f"{5 - float(row['range_m']):.4f}"}


def pixels(row: Row, column: Callable[[float], float], line: Callable[[float], float]) -> Row:
    kept = {key: row[key] for key in ("frame", "landmark", "visible")}
    x_px, y_px = column(float(row["x_px"])), line(float(row["y_px"]))
    return {**kept, "x_px": f"{x_px:.2f}", "y_px": f"{y_px:.2f}"}


@pytest.mark.parametrize(
    ("change", "reasons"),
    [
        (lambda row: pixels(row, lambda x: x, lambda y: 255 - y), ["y_px counted from the top"]),
        (
            lambda row: pixels(row, lambda x: x - 15, lambda y: y - 15),
            ["x_px were that stated +15 px", "y_px were that stated +15 px"],
        ),
        (
            lambda row: pixels(row, lambda x: x / 2, lambda y: y / 2),
            ["x_px were that stated times 2", "other pictures"],
        ),
        (lambda row: moved(row, 100), ["100 frames earlier (25 s)"]),
        (radians, ["sign of their bearings", "radians"]),
        (far_end, ["sign of their bearings", "--range-order"]),
        (lambda row: mirrored(moved(row, 12)), ["sign of their bearings", "12 frames earlier"]),
    ],
)
def test_another_reading_is_told_where_it_explains_nearly_all(
    here: Path, pan: Path, change: Callable[[Row], Row], reasons: list[str]
) -> None:
    truth = changed(here / "gt.csv", SAMPLES / "pan.gt.csv", change)
    line = evaluated(pan, truth, code=3).stderr.partition("\n")[0]
    assert all(reason in line for reason in ["clearly better", *reasons])
    assert line.count(" and ") == len(reasons) - 1


@pytest.mark.parametrize(
    ("change", "told", "code"),
    [
        # Every fourth frame was labelled, and these were counted.
        (lambda row: {**polar(row), "frame": f"{int(row['frame']) / 4:g}"}, "numbers times 4", 3),
        (swung, "range of a claim of their ID", 3),
        (lambda row: moved(row, 3 * (int(row["frame"]) > 60)), "on would fit the claims", 3),
        (
            lambda row: {
                **polar(row),
                "orientation_deg": f"{90 - float(row['orientation_deg']):.3f}",
            },
            "counter-clockwise",
            0,
        ),
        (lambda row: polar(row) if row["landmark"] == "1" else {}, "ID.3 in 76 frames", 0),
        (lambda row: polar(row) if row["visible"] == "1.0" else {}, "the image's edge", 0),
    ],
)
def test_rows_of_other_frames_or_bearings_and_missing_ones_are_told(
    here: Path, pan: Path, change: Callable[[Row], Row], told: str, code: int
) -> None:
    rows = [row for row in map(change, read_rows(SAMPLES / "pan.gt.csv")) if row]
    truth = here / "gt.csv"
    write_rows(truth, [row for row in rows if "." not in row["frame"]])
    done = evaluated(pan, truth, code=code)
    assert told in done.stderr + done.stdout


@pytest.mark.parametrize(("rows", "code"), [("", 1), ("5,none,2,0\n", 0)])
def test_a_log_without_landmarks_is_scored_for_false_claims(
    here: Path, pan: Path, rows: str, code: int
) -> None:
    truth = here / "gt.csv"
    truth.write_text(f"frame,landmark,range_m,bearing_deg\n{rows}")
    evaluated(pan, truth, code=code)
    if not code:
        cells = read_rows(here / "ev/confusion.csv")
        strict = {r["landmark"]: r for r in cells if (r["protocol"], r["method"])[1] == "framework"}
        assert int(strict["total"]["fp"]) == 160  # all that it claims
        assert strict["total"]["tpr"] == ""


@pytest.mark.parametrize("range_m", ["2.0", "3.5"])
def test_few_claims_of_which_none_is_right_are_told(here: Path, pan: Path, range_m: str) -> None:
    """With sectors of the set inverted, three claims were made, and no word was said."""
    few = shutil.copytree(pan, here / "few")
    rows = read_rows(few / "estimates.csv")
    kept = [row for row in rows if row["method"] == "framework" and row["landmark"] == "1"]
    for row in rows:
        row["declared"] = str(int(any(row is k for k in kept[30:33])))
    write_rows(few / "estimates.csv", rows)
    where = {"1": range_m, "3": "2.1"}
    truth = changed(
        here / "gt.csv",
        SAMPLES / "pan.gt.csv",
        lambda r: {**polar(r), "range_m": where[r["landmark"]]},
    )
    done = evaluated(few, truth, code=3)  # the table was changed
    assert ("none of 3 claims" in done.stdout) == (range_m == "3.5")


def test_own_claims_taken_for_truth_are_noted(here: Path, pan: Path) -> None:
    claims = [row for row in read_rows(pan / "estimates.csv") if row["declared"] == "1"]
    claims = [row for row in claims if row["method"] == "framework"]
    truth = here / "gt.csv"
    write_rows(
        truth, [{k: row[k] for k in ("frame", "landmark", "x_px", "y_px")} for row in claims]
    )
    assert "made from results" in evaluated(pan, truth).stdout


def test_few_claims_that_are_right_by_chance_are_doubted(here: Path, pan: Path) -> None:
    """Four of 156 were right, and the truth of another log was scored without a word."""
    truth = changed(here / "gt.csv", SAMPLES / "faint" / "gt.csv", polar)
    told = evaluated(pan, truth, code=3).stderr
    assert re.search(r"\b4 of \d+ rows on pan and 9 of \d+ claims of framework meet", told)
    both = sonarrec("evaluate", pan, "--ground-truth", SAMPLES / "faint" / "gt.csv", code=3)
    assert "3 px" in both.stderr


def test_a_log_and_its_results_are_not_taken_for_each_other(here: Path, pan: Path) -> None:
    shutil.copytree(pan, "sonarrec_out/pan")
    assert "results, not a log" in sonarrec("run", "sonarrec_out", code=2).stderr
    assert "results, not a log" in sonarrec("run", pan, "-o", "other", code=2).stderr
    for of in ("evaluate", "report"):
        told = sonarrec(of, SAMPLE, code=2).stderr
        assert f"its results are in {Path('sonarrec_out/pan')}" in told
    bare = here / "bare"
    bare.mkdir()
    shutil.copy(SAMPLE / "000000.png", bare)
    flags = ("--height-m", "0.68", "--no-flip", "--apex-px", "95", "383.5")
    for shown in (
        sonarrec("info", bare, *flags).stdout,
        sonarrec("run", bare, *flags, code=1).stderr,
    ):
        (words,) = (words for words in commands(shown) if "--write-sonar" in words)
        assert {*flags} <= {*words}


@pytest.mark.parametrize(
    ("said", "changed_ns"),
    [
        ("", lambda ns: ns),
        ("only in s;", lambda ns: ns // 10**9),
        ("only in ms;", lambda ns: ns // 10**6),
        ("only in us;", lambda ns: ns // 10**3),
        ("only with -1 h", lambda ns: ns + 3600 * 10**9),
        ("only with +5.5 h", lambda ns: ns - 19_800 * 10**9),
        ("whole seconds", lambda ns: ns // 10**9 * 10**9),
        ("whole seconds", lambda ns: round(ns / 10**9) * 10**9),
    ],
)
def test_times_by_another_clock_are_refused(
    here: Path, pan: Path, said: str, changed_ns: Callable[[int], int]
) -> None:
    """The log begins at 0, so all rows in s fell on its first frame, and nothing was said."""

    def timed(row: Row) -> Row:
        frame, *rest = polar(row).items()  # at 4 Hz
        return {"timestamp_ns": str(changed_ns(int(frame[1]) * 250_000_000)), **dict(rest)}

    truth = changed(here / "gt.csv", SAMPLES / "pan.gt.csv", timed)
    assert said in evaluated(pan, truth, code=1 if said else 0).stderr
    assert said in sonarrec("truth", "check", truth, SAMPLE, code=3 if said else 0).stdout


@pytest.mark.parametrize("black", [(), (2,), (1, 3)])
def test_black_frames_among_others_are_noted(here: Path, black: tuple[int, ...]) -> None:
    log = sample_log(here / "dive", 4)
    for n in black:
        cv2.imwrite(str(log / f"{n:06d}.png"), np.zeros((256, 191), np.uint8))
    told = [line for line in sonarrec("run", log).stderr.splitlines() if "are black" in line]
    assert len(told) == bool(black)
    assert all(f"{len(black)} of 4 frames" in t and f"them {black[0]};" in t for t in told)


def test_a_part_that_is_labelled_is_scored_alone_as_is_advised(here: Path, pan: Path) -> None:
    part = [row for row in read_rows(SAMPLES / "pan.gt.csv") if int(row["frame"]) < 64]
    truth = here / "gt.csv"
    write_rows(truth, part)
    told = evaluated(pan, truth, code=3).stderr
    assert "64 frames without" in told
    assert "--labelled-only" in told
    assert "64 of 128" in evaluated(pan, truth, "--labelled-only").stdout


SET = """
name = "own"
radius_m = {radius}
ring = [0.8, 1.0]
symbol = [0.0, 0.62]
[[landmark]]
id = 11
sectors = [1, 0, 0, 0]
[[landmark]]
id = 12
sectors = [1, 1, 0, 0]
"""


@pytest.mark.parametrize("log", but_first(["polar", "pan", "faint"]))
def test_a_radius_that_is_clearly_wrong_is_told(log: str) -> None:
    for radius in (0.075, 0.15, 0.2):
        Path("own.toml").write_text(SET.format(radius=radius))
        with open_log(SAMPLES / log) as opened:
            sizes = RingSizes(load_landmarks("own.toml"))
            for frame in opened:
                sizes.inspect(frame)
        found = sizes.other()
        assert (found is None) == (radius == 0.15)
        if found is not None:
            assert found == pytest.approx(0.15, rel=0.15)


def test_no_other_radius_is_sought_where_stage_1_found_clear_rings() -> None:
    """In a quarter of the frames; and in fewer it is."""
    Path("own.toml").write_text(SET.format(radius=0.075))
    for every, doubted in ((3, False), (6, True)):
        sizes = RingSizes(load_landmarks("own.toml"))
        with open_log(SAMPLES / "pan") as opened:
            for n, frame in enumerate(opened):
                sizes.inspect(frame, contrast=0.4 + 0.5 * (n % every == 0))
        assert (sizes.other() is not None) == doubted


def test_run_tells_it_with_the_radius_that_fits() -> None:
    Path("own.toml").write_text(SET.format(radius=0.075))
    told = sonarrec(
        "run", SAMPLES / "pan.mcap", "--landmarks", "own.toml", "--frames", ":40", "-q"
    ).stderr
    found = re.search(r"rings of about (\S+) m radius fit clearly better .* own, 0.075 m", told)
    assert found is not None
    assert float(found[1]) == pytest.approx(0.15, rel=0.15)
    run_named(told, Path("sonarrec_out/pan"))


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="the recordings of others are not here")
def test_right_radii_of_others_recordings_are_not_doubted() -> None:
    tried = 0
    for folder in sorted({toml.parent for toml in DATA.rglob("sonar.toml")}):
        if not (folder / "gt.csv").exists() and folder.parent.name != "rays":
            continue
        with open_log(folder) as opened:
            sizes = RingSizes(load_landmarks("basin"))
            for frame in opened:
                sizes.inspect(frame)
        assert sizes.other() is None, folder
        tried += 1
    assert tried >= 10


@pytest.mark.slow
def test_a_rerun_that_was_stopped_is_told(here: Path) -> None:
    log = here / "pan.mcap"
    for name in ("pan.mcap", "pan.sonar.toml", "pan.gt.csv"):
        shutil.copy(SAMPLES / name, here)
    sonarrec("run", log, "-q")
    line = f"what that one has written is in {Path('sonarrec_out/pan.part')}"
    for words in (["run", log, "-q"], ["evaluate", "sonarrec_out/pan"]):
        assert line not in sonarrec(*words).output
    rerun = subprocess.Popen(
        [sys.executable, "-m", "sonarrec", "run", log, "--preset", "paper,default,offline", "-q"],
        stderr=subprocess.PIPE,
    )
    frames = here / "sonarrec_out/pan.part/frames.csv"
    while rerun.poll() is None and not (frames.is_file() and frames.read_bytes().count(b"\n") > 9):
        pass
    rerun.send_signal(signal.SIGINT)
    rerun.communicate()
    assert rerun.returncode == 130
    for words in (
        ["run", log],
        ["run", log, "--dry-run"],
        ["evaluate", "sonarrec_out/pan"],
        ["overlay", log, "-o", "x.mp4", "--frames", "0:2"],
    ):
        assert line in sonarrec(*words).output, words


def test_heights_and_tilts_that_nobody_stated_are_not_told_as_stated(here: Path) -> None:
    log = sample_log(here / "log", 6)
    toml = log / "sonar.toml"
    toml.write_text(toml.read_text().replace("height_m = 0.68\n", ""))
    (line,) = [x for x in sonarrec("run", log).stderr.splitlines() if ": geometry " in x]
    assert re.search(r"tilt 20 deg, height 0\.\d+ m estimated", line)
    toml.write_text(toml.read_text().replace("tilt_deg = 20.0", "height_m = 0.68"))
    (line,) = [x for x in sonarrec("run", log).stderr.splitlines() if ": geometry " in x]
    assert re.search(r"tilt \S+ deg assumed, height 0.68 m \(", line)


def test_ranges_without_a_window_lack_it_and_contradict_nothing(here: Path) -> None:
    log = here / "polar"
    log.mkdir()
    for n in range(2):
        shutil.copy(SAMPLES / "polar" / f"{n:06d}.png", log)
    image = cv2.imread(str(log / "000000.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    ranges = np.linspace(2, 5, image.shape[0]).round(4).tolist()
    (log / "sonar.toml").write_text(
        f'[sonar]\nlayout = "polar"\nranges_m = {ranges}\nfield_of_view_deg = 28.8\ntilt_deg = 20\n'
    )
    told = sonarrec("info", log).stdout
    assert "lacks range_min_m, range_max_m" in told
    assert "contradicts" not in told
    assert "2 of 2" in told
    assert "lacks range_min_m, range_max_m" in sonarrec("run", log, code=1).stderr


def test_small_slips_are_told_as_they_were_typed(here: Path, pan: Path) -> None:
    told = sonarrec("evaluate", "--compare", pan, pan, "-v", code=2).stderr
    assert "-v" in told
    assert "RESULTS" not in told
    log = sample_log(here / "log", 1)
    toml = log / "sonar.toml"
    toml.write_text(toml.read_text().replace('"fan"', "fan"))
    assert 'layout = "fan"' in sonarrec("run", log, code=2).stderr
    (here / "empty" / "sub").mkdir(parents=True)
    (here / "empty" / "notes.txt").touch()
    assert "--recursive" not in sonarrec("run", here / "empty", "--recursive", code=2).stderr
    sample_log(here / "empty" / "sub" / "log", 1)
    assert "--recursive" in sonarrec("run", here / "empty", code=2).stderr


def test_overlay_names_the_run_that_writes_the_results_it_looked_for(here: Path) -> None:
    log = sample_log(here / "my log", 3)
    call = ("overlay", log, "no results", "-o", "x.mp4")
    run_named(sonarrec(*call, code=2).stderr, log)
    sonarrec(*call)
