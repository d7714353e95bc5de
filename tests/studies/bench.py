"""`make bench`: what a frame costs, on one core, beside what it could cost.

CPU time, the least of rounds in which every task has its turn. A busy machine makes this program
slower than it makes decoding, so ratios hold only on a quiet one: how busy it was is told, and what
a busy core beside does to both. Nothing is asserted: time is not a test.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self
from unittest.mock import patch

import cv2
import numpy as np

from sonarrec.api.run import run as run_log
from sonarrec.config import Config, preset
from sonarrec.readers import log as readers_log
from sonarrec.readers.containers import images
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import FloorPlane
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler
from sonarrec.recogniser.three_stages import FRAMEWORK, DiscStages
from sonarrec.results.write import ResultsWriter
from sonarrec.simulation.motion import poses
from sonarrec.simulation.scene import MotionSection, PlacedLandmark, PlacedObject, Scene
from sonarrec.simulation.simulate import write_recording
from tests.studies.baseline import HALF, METHOD, HoughSmi, Settings, fan_of, read_grey
from tests.studies.learning.plates import random_scene
from tests.studies.results.record import SAMPLES, judge, options, save, show
from tests.support.batch import peak_mb
from tests.support.counted import counted
from tests.support.logs import cdr_image, mcap_file
from tests.support.simulated import Job, recognise, score

FRAMES = 144
REPEATS = 4
QUIET = 0.5  # load average; on a busier machine wall times say nothing
SHORT, LOGS = 60, 8  # frames in a short log, and how many of them one run takes
LONG = (500, 3000)
EVALUATED = 60  # logs
MINUTES = 4  # times the frames of a scene, in the logs of which two run at once
PLATES = 5001  # the seed of a scene of drawn plates, none that anything was chosen on
ENCODINGS = {"Sub": cv2.IMWRITE_PNG_FILTER_SUB, "Paeth": cv2.IMWRITE_PNG_FILTER_PAETH}
"""Filters of PNGs: OpenCV writes Sub, and other programs mostly Paeth, which takes longer."""
# Seeds of scenes on which the baseline's rates are reported: none that it was tuned on.
REPORTED = 505, 506
PEERS = {METHOD: Settings(), "hough_half": HALF}


def three_in_view() -> Scene:
    """Three landmarks, all in view in every frame of a pan of 6 degrees to and fro."""
    return Scene(
        name="three",
        frames=FRAMES,
        motion=MotionSection(pan_min_deg=-3, pan_max_deg=3, pan_start_deg=-3, pan_deg_s=2),
        landmarks=(
            PlacedLandmark(1, ground_m=1.6, azimuth_deg=-5.0, orientation_deg=30.0),
            PlacedLandmark(3, ground_m=2.2, azimuth_deg=0.0, orientation_deg=110.0),
            PlacedLandmark(4, ground_m=1.7, azimuth_deg=6.0, orientation_deg=250.0),
        ),
    )


EIGHT = (
    *((PlacedLandmark, {"id": 1}), (PlacedObject, {"kind": "blank"})),
    *((PlacedObject, {"kind": "half_ring"}), (PlacedLandmark, {"id": 3})),
    *((PlacedObject, {"kind": "filled"}), (PlacedObject, {"kind": "tyre"})),
    *((PlacedLandmark, {"id": 4}), (PlacedObject, {"kind": "spokes"})),
)
"""Three landmarks and five fakes, in the order in which they come into view."""


def eight_in_a_pan() -> Scene:
    """The eight over 56 degrees, of which a pan of 20 degrees either way shows three to five."""
    return Scene(
        name="eight",
        seed=505,
        frames=FRAMES,
        motion=MotionSection(pan_min_deg=-20, pan_max_deg=20, pan_start_deg=-20, pan_deg_s=2),
        **_placed([(1.6 + 0.3 * (n % 3), 8.0 * n - 28) for n in range(len(EIGHT))]),
    )


def vehicle() -> Scene:
    """The eight along the way of a vehicle that drives .3 m/s and turns by up to 6 deg/s."""
    motion = MotionSection(
        pan_min_deg=0,
        pan_max_deg=0,
        pan_start_deg=0,
        pan_deg_s=0,
        yaw_jitter_deg=0.1,
        heave_m=0.01,
        surge_m_s=0.3,
        yaw_swing_deg_s=6,
        pitch_deg=1,
        roll_deg=1,
    )
    scene = Scene(name="vehicle", seed=506, frames=FRAMES, motion=motion)
    way = poses(scene)[:: FRAMES // len(EIGHT)]
    ahead = (np.radians([p.pan_deg + 5 * (-1) ** n for n, p in enumerate(way)]), 2.2)
    x = [p.x_m for p in way] + ahead[1] * np.sin(ahead[0])
    y = [p.y_m for p in way] + ahead[1] * np.cos(ahead[0])
    return replace(
        scene, **_placed(np.column_stack([np.hypot(x, y), np.degrees(np.arctan2(x, y))]))
    )


def _placed(positions: Iterable[Sequence[float]]) -> dict[str, Any]:
    """EIGHT as a scene's landmarks and objects. positions: (8, 2) ground range, m, and azimuth."""
    items = [
        kind(**what, ground_m=float(ground_m), azimuth_deg=float(azimuth), orientation_deg=50.0 * n)
        for n, ((kind, what), (ground_m, azimuth)) in enumerate(zip(EIGHT, positions, strict=True))
    ]
    return {
        "landmarks": tuple(item for item in items if isinstance(item, PlacedLandmark)),
        "objects": tuple(item for item in items if isinstance(item, PlacedObject)),
    }


def far() -> Scene:
    """The same in a window of 5 m, half as far out again."""
    near = three_in_view()
    sonar = replace(near.sonar, range_min_m=1.25, range_max_m=6.25, height_m=1.0, tilt_deg=18.0)
    placed = tuple(replace(x, ground_m=1.5 * x.ground_m) for x in near.landmarks)
    return replace(near, name="far", sonar=sonar, landmarks=placed)


def wide() -> Scene:
    """The same seen by a multibeam sonar: 512 beams over 130 deg, 1,024 range bins to 10 m."""
    near = three_in_view()
    sonar = replace(
        near.sonar,
        layout="polar",
        beams=512,
        field_of_view_deg=130.0,
        range_bins=1024,
        range_min_m=0.5,
        range_max_m=10.0,
        height_m=1.5,
        tilt_deg=15.0,
    )
    placed = tuple(replace(x, ground_m=2 * x.ground_m) for x in near.landmarks)
    return replace(near, name="wide", sonar=sonar, landmarks=placed)


PARTS: dict[str, tuple[float | None, tuple[tuple[object, str], ...]]] = {
    "digest": (0.05, ((readers_log, "digest_of"),)),
    "decode": (None, ((images, "decode_image"), (images, "_contents"))),
    "warp": (0.25, ((FloorPlane, "warp"),)),
    "restore": (0.08, ((Levels, "_echoes"), (Unchanging, "_use"))),
    "stage 1": (0.6, ((CandidateSelector, "__call__"),)),
    "motion": (0.45, ((Odometry, "step"),)),
    "stage 2": (0.35, ((ContinuityFilter, "step"),)),
    "stage 3": (
        0.4,
        (
            (CandidateSelector, "levels"),
            (ShapeSampler, "__call__"),
            (AppearanceMeasurement, "gather"),
            (DiscStages, "stage3"),
        ),
    ),
    "rows": (0.08, ((ResultsWriter, "write"),)),
}
"""Of a frame's work: its budget, ms on a quiet core, and the functions that do it."""
OTHER = "other", 0.15


class Parts:
    """What each part of a frame costs, while `run` works in a `with` block of it.

    spent: CPU seconds. calls: of functions of numpy and OpenCV, but for those behind operators.
    """

    def __init__(self, *, count: bool = False) -> None:
        self.spent, self.calls = Counter[str](), Counter[str]()
        self._count, self._open = count, [OTHER[0]]
        self._since = 0.0

    def _switch(self) -> None:
        """Charge the time since the last switch to the part that is open."""
        now = time.process_time()
        self.spent[self._open[-1]] += now - self._since
        self._since = now

    def _timed(self, work: Callable[..., object], part: str) -> Callable[..., object]:
        def timed(*arguments: object, **named: object) -> object:
            self._switch()
            self._open.append(part)
            try:
                return work(*arguments, **named)
            finally:
                self._switch()
                self._open.pop()

        return timed

    def _called(self, _: object, event: str, function: object) -> None:
        owner = (
            getattr(function, "__module__", None)
            or type(getattr(function, "__self__", None)).__module__
        )
        if event == "c_call" and str(owner).startswith(("numpy", "cv2")):
            self.calls[self._open[-1]] += 1

    def __enter__(self) -> Self:
        with ExitStack() as kept:
            for part, (_, functions) in PARTS.items():
                for owner, name in functions:
                    work = getattr(owner, name)
                    kept.enter_context(patch.object(owner, name, self._timed(work, part)))
            self._kept = kept.pop_all()
        self._since = time.process_time()
        if self._count:
            sys.setprofile(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        self._switch()
        self._kept.close()


def parts(scene: str, run: Callable[[], object]) -> None:
    """Print what each part of a scene's frame costs, beside its budget, and its calls."""
    rounds = []
    for _ in range(REPEATS):
        with Parts() as one:
            run()
        rounds.append(one.spent)
    with Parts(count=True) as counted:
        run()
    budgets = {**{part: budget for part, (budget, _) in PARTS.items()}, OTHER[0]: OTHER[1]}
    show(
        f"A frame of {scene} by its parts, least of {REPEATS} rounds",
        [
            {
                "part": part,
                "ms": f"{min(spent[part] for spent in rounds) / FRAMES * 1e3:.2f}",
                "budget": "" if budget is None else f"{budget:g}",
                "calls": round(counted.calls[part] / FRAMES),
            }
            for part, budget in budgets.items()
        ],
    )


def interleaved(tasks: dict[Any, Callable[[], object]]) -> dict[Any, float]:
    """Least CPU seconds of each task, of REPEATS rounds in which every task has its turn."""
    taken: dict[Any, list[float]] = {name: [] for name in tasks}
    for task in tasks.values():
        task()  # files into the cache, imports done
    for _ in range(REPEATS):
        for name, task in tasks.items():
            start = time.process_time()
            task()
            taken[name].append(time.process_time() - start)
    return {name: min(values) for name, values in taken.items()}


@contextmanager
def busy_core() -> Iterator[None]:
    """Another core does nothing but count, where there is another."""
    others = {*range(os.cpu_count() or 1)} - os.sched_getaffinity(0)
    spin = f"import os\nos.sched_setaffinity(0, {others or {0}})\nwhile True: pass"
    process = subprocess.Popen([sys.executable, "-c", spin])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def others_share(since: tuple[float, float, float] | None = None) -> tuple[float, float, float]:
    """Seconds that all cores were at work, that this program was, and of the clock; the differences
    to an earlier call. Zeros where the system does not say."""
    stat, own = Path("/proc/stat"), os.times()
    if not stat.exists():
        return 0.0, 0.0, 0.0
    ticks = [int(value) for value in stat.read_text("ascii").splitlines()[0].split()[1:9]]
    busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")  # but for idle and waiting
    now = busy, sum(own[:4]), time.monotonic()
    return now if since is None else tuple(n - b for n, b in zip(now, since, strict=True))


def write_mcap(path: Path, images: Iterable[np.ndarray], compression: str, sonar: Path) -> None:
    """One image channel at 4 Hz, with its sonar.toml beside it."""
    messages = (("/sonar", n * 250_000_000, cdr_image(image)) for n, image in enumerate(images))
    mcap_file(path, messages, compression=compression, chunk_size=2**20)
    path.with_suffix(".sonar.toml").write_bytes(sonar.read_bytes())


def written_as(source: Path, folder: Path, png_filter: int) -> None:
    """A log of images, with every picture encoded by this filter."""
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("*.png"))
    for path in source.glob("*.png"):
        how = [cv2.IMWRITE_PNG_FILTER, png_filter]
        assert cv2.imwrite(str(folder / path.name), read_grey(path), how)


def alone(work: Path, log: str) -> str:
    """The name of a log of its first picture only."""
    shutil.copytree(work / log, work / f"{log}_1", ignore=shutil.ignore_patterns("*.png"))
    shutil.copy(min((work / log).glob("*.png")), work / f"{log}_1")
    return f"{log}_1"


def cost(work: Path) -> None:
    """Print the cost per frame and its ratios."""
    scenes = {"three": three_in_view(), "eight": eight_in_a_pan(), "vehicle": vehicle()}
    three = scenes["three"]
    polar = replace(three, name="polar", sonar=replace(three.sonar, layout="polar"))
    plates = replace(random_scene(PLATES, frames=FRAMES // 2), name="plates")
    for scene in (*scenes.values(), polar, far(), wide(), plates):
        write_recording(scene, work / scene.name)
    for name, png_filter in ENCODINGS.items():
        written_as(SAMPLES / "pan", work / f"sample {name}", png_filter)
    pictures = [read_grey(p) for p in sorted((work / "three").glob("*.png"))]
    for compression in ("none", "zstd"):
        path = work / f"{compression}.mcap"
        write_mcap(path, pictures, compression, work / "three" / "sonar.toml")
    settings = preset("default")

    def decode(log: str) -> Callable[[], object]:
        paths = sorted((work / log).glob("*.png"))
        return lambda: [read_grey(path) for path in paths]

    def hough(log: str, how: Settings) -> Callable[[], object]:
        paths = sorted((work / log).glob("*.png"))
        rival = HoughSmi(fan_of(work / log, read_grey(paths[0])), three.landmark_set, how)
        return lambda: [rival(read_grey(path)) for path in paths]

    def ours(log: str, settings: Config = settings) -> Callable[[], object]:
        return lambda: run_log(work / log, work / "out", preset=settings, overwrite=True)

    logs = (*scenes, "far", "wide", "plates", *(f"sample {name}" for name in ENCODINGS))
    tasks = {(log, "decode the PNGs"): decode(log) for log in logs}
    for log in scenes:
        tasks |= {(log, name): hough(log, how) for name, how in PEERS.items()}
    tasks |= {(log, "sonarrec"): ours(log) for log in logs}
    tasks |= {(log, "one picture"): ours(alone(work, log)) for log in logs}
    tasks |= {
        ("three", "sonarrec from raw MCAP"): ours("none.mcap"),
        ("three", "sonarrec from zstd MCAP"): ours("zstd.mcap"),
        ("three", "sonarrec from polar PNG"): ours("polar"),
        ("three", "sonarrec --preset offline"): ours("three", preset("offline")),
    }
    frames = {log: len([*(work / log).glob("*.png")]) for log in logs}
    seconds = interleaved(tasks)
    ms = {(log, name): taken / frames[log] * 1e3 for (log, name), taken in seconds.items()}
    rows, columns = pictures[0].shape
    print(f"\nCost per frame, {rows} x {columns} fan (wide: 1,024 bins of 512 beams, polar),")
    print(
        f"{FRAMES} frames, CPU time on one core, least of {REPEATS} interleaved rounds; sonarrec:"
    )
    print("all that `run` does (hashing the input, set-up, decoding, three stages, CSV files)\n")
    found = {log: rates(scene, work / "rates" / log) for log, scene in scenes.items()}
    show(
        "What a frame costs, and in the same scenes TPR / FPR (strict)",
        [
            {
                "scene": log,
                "per frame": name,
                "ms": f"{value:.2f}",
                "/ decoding": f"{value / ms[log, 'decode the PNGs']:.2f}",
                "TPR / FPR": found.get(log, {}).get(name, ""),
            }
            for (log, name), value in ms.items()
            if name != "one picture"
        ],
    )
    # Set-up and end are what a log of one picture costs, but for that frame.
    each = {
        log: (seconds[log, "sonarrec"] - seconds[log, "one picture"]) / (frames[log] - 1)
        for log in logs
    }
    show(
        "Set-up and end of a run, apart from its frames",
        [
            {
                "scene": log,
                "set-up and end, ms": f"{(seconds[log, 'one picture'] - each[log]) * 1e3:.0f}",
                "a frame, ms": f"{each[log] * 1e3:.2f}",
                "/ decoding": f"{each[log] * 1e3 / ms[log, 'decode the PNGs']:.2f}",
            }
            for log in logs
        ],
    )
    if hasattr(os, "sched_setaffinity"):
        beside_a_busy_core({name: tasks["eight", name] for name in ("decode the PNGs", "sonarrec")})
    print()
    for log in scenes:
        judge(f"{log}: sonarrec / Hough loop", ms[log, "sonarrec"] / ms[log, METHOD], 0.9)
    decoded = {log: ms[log, "decode the PNGs"] for log in logs}
    for log, bound in (("three", 2.6), ("eight", 2.6), ("vehicle", 2.8)):
        judge(f"{log}: sonarrec / decoding", ms[log, "sonarrec"] / decoded[log], bound)
    judge("vehicle / eight", ms["vehicle", "sonarrec"] / ms["eight", "sonarrec"], 1.4)
    once = ms["three", "sonarrec"]
    raw = ms["three", "sonarrec from raw MCAP"] / decoded["three"]
    judge("from raw MCAP / decoding the PNGs", raw, 2.1)
    judge("offline / default", ms["three", "sonarrec --preset offline"] / once, 1.25)
    for log, bound in (("far", 3.0), ("wide", 4.0)):
        judge(f"{log} / decoding", ms[log, "sonarrec"] / decoded[log], bound)
    judge("plates, a frame, ms", each["plates"] * 1e3, 7)
    for log in scenes:
        parts(log, ours(log))
    memory(work, pictures)


def beside_a_busy_core(tasks: dict[str, Callable[[], object]]) -> None:
    """Print what tasks on the frames of `eight` cost while another core is idle and busy."""
    idle = interleaved(tasks)
    with busy_core():
        busy = interleaved(tasks)
    show(
        "eight, with the other core idle and busy",
        [
            {
                "per frame": name,
                "idle, ms": f"{idle[name] / FRAMES * 1e3:.2f}",
                "busy, ms": f"{busy[name] / FRAMES * 1e3:.2f}",
                "busy / idle": f"{busy[name] / idle[name]:.2f}",
            }
            for name in tasks
        ],
    )


def rates(scene: Scene, folder: Path) -> dict[str, str]:
    """TPR / FPR in a scene, protocol strict, of sonarrec and of PEERS."""
    recognise(Job(scene, folder, [preset("default")], PEERS))
    names = {FRAMEWORK: "sonarrec"} | {name: name for name in PEERS}
    return {
        names[method]: f"{count.tpr:.3f} / {count.fpr:.4f}"
        for (protocol, method), count in counted(score([folder])).items()
        if protocol == "strict" and method in names
    }


def memory(work: Path, images: list[np.ndarray]) -> None:
    """Print the peak memory of `sonarrec run` on a short and on a long log, and on a wide one."""
    print("\nPeak memory of `sonarrec run` on a raw MCAP (the scene's frames over and over)\n")

    def peak(log: Path, *options: str) -> float:
        command = [sys.executable, "-m", "sonarrec", "run", str(log), "-q", *options]
        return peak_mb([*command, "--out", str(work / "long")])

    peaks = []
    for frames in LONG:
        log = work / f"long_{frames}.mcap"
        repeated = (images[n % len(images)] for n in range(frames))
        write_mcap(log, repeated, "none", work / "three" / "sonar.toml")
        peaks.append(peak(log))
        log.unlink()
        judge(f"peak memory, {frames} frames, MB", peaks[-1], 130)
    judge(f"peak memory, {LONG[1]} / {LONG[0]} frames", peaks[1] / peaks[0], 1.05)
    judge(f"peak memory, {FRAMES} PNGs, 130 deg, MB", peak(work / "wide"), 140)
    offline = peak(work / "wide", "--preset", "offline")
    judge(f"peak memory, {FRAMES} PNGs, 130 deg, offline, MB", offline, 180)
    poses = "".join(f"{n / 20:.2f},{n % 7},0,0\n" for n in range(2000))
    table = work / "poses.csv"
    table.write_text(f"timestamp,yaw,x,y\n{poses}", encoding="utf-8")
    with_poses = peak(work / "three", "--odometry", str(table))
    judge(f"peak memory, {FRAMES} PNGs with poses, MB", with_poses, 140)


def least_s(*arguments: str) -> float:
    """Least CPU seconds of a command of the program."""
    taken = []
    for _ in range(REPEATS + 1):
        command = [sys.executable, "-m", "sonarrec", *arguments]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, capture_output=True)
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(now.ru_utime - before.ru_utime + now.ru_stime - before.ru_stime)
    return min(taken)


def start(work: Path) -> None:
    """Print what short runs cost."""
    print(f"\nShort runs, CPU time, least of {REPEATS + 1}\n")
    judge("sonarrec --help, s", least_s("--help"), 0.3)
    run = ("run", str(work / "three"), "-q", "--overwrite", "--out", str(work / "short"))
    judge("run on one frame, s", least_s(*run, "--frames", ":1"), 0.42)
    logs = [work / f"short_{number}" for number in range(LOGS)]
    for log in logs:
        log.mkdir()
        for file in [
            work / "three" / "sonar.toml",
            *sorted((work / "three").glob("*.png"))[:SHORT],
        ]:
            shutil.copy(file, log)
    taken = least_s("run", *map(str, logs), *run[2:], "--jobs", "1")
    judge(f"{LOGS} logs of {SHORT} frames, ms a frame, all told", taken / LOGS / SHORT * 1e3, 7.5)


def pages(work: Path) -> None:
    """Print what a report of the sample log and an evaluation of many such logs cost."""
    results, truth = work / "results", work / "truth"
    truth.mkdir()
    run = least_s("run", str(SAMPLES / "pan"), "-q", "--overwrite", "-o", str(results))
    page = str(work / "report.html")
    report = least_s("report", str(results / "pan"), "--log", str(SAMPLES / "pan"), "-o", page)
    for number in range(EVALUATED):
        shutil.copytree(results / "pan", work / "many" / f"log_{number}")
        shutil.copy(SAMPLES / "pan" / "gt.csv", truth / f"log_{number}.gt.csv")
    evaluate = least_s("evaluate", "-q", "--ground-truth", str(truth), str(work / "many"))
    print(f"\nThe sample log, CPU time, least of {REPEATS + 1}\n")
    judge("report of one log / its run", report / run, 1.2)
    judge(f"evaluate of {EVALUATED} logs / a run", evaluate / run, 6)


_DECODER = """
import sys, cv2
from pathlib import Path
cv2.setNumThreads(1)
for path in sorted(Path(sys.argv[1]).glob("*.png")):
    cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
"""


def two_jobs(work: Path) -> None:
    """Print by how much two jobs are faster than one, beside two decoders. On all cores."""
    logs = []
    for scene in ("eight", "vehicle"):
        logs.append(work / f"{scene}_minutes")
        logs[-1].mkdir()
        (logs[-1] / "sonar.toml").symlink_to(work / scene / "sonar.toml")
        pictures = sorted((work / scene).glob("*.png")) * MINUTES
        for number, picture in enumerate(pictures):
            (logs[-1] / f"{number:06d}.png").symlink_to(picture)
    every = {*range(os.cpu_count() or 1)}
    run = ["-m", "sonarrec", "run", *map(str, logs), "-q", "--overwrite", "-o", str(work / "jobs")]

    def clock(*sets: Sequence[str]) -> float:
        """Least seconds until all of these, begun at once, have ended."""
        taken = []
        for _ in range(2):
            begun = time.monotonic()
            started = [subprocess.Popen([sys.executable, *arguments]) for arguments in sets]
            assert not any(process.wait() for process in started)
            taken.append(time.monotonic() - begun)
        return min(taken)

    pinned = os.sched_getaffinity(0)
    os.sched_setaffinity(0, every)  # for the commands below
    try:
        one, two = (clock([*run, "--jobs", jobs]) for jobs in "12")
        decoders = [["-c", _DECODER, str(log)] for log in logs]
        in_turn, at_once = sum(map(clock, decoders)), clock(*decoders)
    finally:
        os.sched_setaffinity(0, pinned)
    print("\nTwo logs at once, by the clock\n")
    least = 0.95 * in_turn / at_once
    judge(f"--jobs 2 over --jobs 1, {len(every)} cores", one / two, least, at_least=True)


def main() -> None:
    """All of it on one core."""
    parser = options("bench", __doc__)
    parser.add_argument("--pinned", action="store_true", help="this process has one core already")
    asked = parser.parse_args()
    if not asked.pinned and hasattr(os, "sched_setaffinity"):
        # Begun anew, for numpy has threads for as many cores as there were when it was imported.
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        again = [sys.executable, "-m", "tests.studies.bench", *sys.argv[1:], "--pinned"]
        os.execv(sys.executable, again)
    cv2.setNumThreads(1)
    load, since = os.getloadavg()[0], others_share()
    show("", [{"others' load on the machine": f"{load:.1f}", "quiet": load < QUIET}])
    with tempfile.TemporaryDirectory(prefix="sonarrec_bench_") as name:
        cost(Path(name))
        start(Path(name))
        pages(Path(name))
        busy, own, clock = others_share(since)
        if clock:
            share = max(busy - own, 0) / clock
            show("", [{"cores that others kept busy meanwhile": f"{share:.2f}"}])
        if hasattr(os, "sched_setaffinity"):
            two_jobs(Path(name))
    save(asked.record)


if __name__ == "__main__":
    main()
