"""Opens recorded logs: any kind of file in, a stream of fan images out.

A further format is one module with a RawLog and one row in READERS.
"""

from __future__ import annotations

import glob
import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from types import TracebackType
from typing import Any, get_args

from sonarrec.geometry import Sonar, check_sonar, load_sonar
from sonarrec.readers.fans import FanImages
from sonarrec.readers.images import IMAGE_SUFFIXES, ImageFiles, is_image, natural_order
from sonarrec.readers.raw import RawFrame, RawLog, UnusableError
from sonarrec.readers.video import VIDEO_SUFFIXES, VideoFrames
from sonarrec.records import Clock, Fan, Frame, SonarrecError, UsageError

SONAR_FILE = "sonar.toml"
MAX_PROBLEM_LINES = 20
SETTLING_FRAMES = 3  # whose commonest size or window is taken to be the log's


def _open_mcap(path: Path, topic: str | None) -> RawLog:
    from sonarrec.readers.mcap.images import McapImages  # with its decompressors, only where needed

    return McapImages(path, topic)


@dataclass(frozen=True, slots=True)
class Reader:
    """One kind of file: its suffixes and how it is opened, with the topic chosen or None."""

    kind: str
    suffixes: frozenset[str]
    open: Callable[[Path, str | None], RawLog]
    has_topics: bool = False


READERS = (
    Reader("image", IMAGE_SUFFIXES, lambda path, _: ImageFiles([path])),
    Reader("video", VIDEO_SUFFIXES, lambda path, _: VideoFrames(path)),
    Reader("MCAP", frozenset({".mcap"}), _open_mcap, has_topics=True),
)


class Log:
    """A recorded log: one pass of Frames, streamed. Use it as a context manager.

    name: of the folder or file, for the results folder. frame_count: frames to come, None where
    unknown. stated: the geometry as file and flags state it. problems: one line for each thing that
    could not be used (at most MAX_PROBLEM_LINES, then a count), complete after the pass.
    """

    def __init__(
        self, path: Path, name: str, files: list[Path], stated: Sonar, raw: RawLog, time: Clock
    ) -> None:
        """files: what the log consists of, in order. time: which of its times names a frame."""
        self.path = path
        self.name = name
        self.stated = stated
        self.frame_count = raw.frame_count
        self.problems: list[str] = []
        self._files = files
        self._raw = raw
        self._time = time
        self._images = FanImages(stated, str(path))

    @property
    def sonar(self) -> Sonar:
        """The geometry as resolved: of polar messages that of the first ping once it was read."""
        return self._images.sonar

    @property
    def fan(self) -> Fan | None:
        """The fan images' geometry, None before the first frame."""
        return self._images.fan

    def reading(self) -> dict[str, Any]:
        """How the log was read, for run.toml: what was chosen, and what the first frame settled."""
        settled: dict[str, Any] = {"time": self._time}
        if self._raw.topic is not None:
            settled["topic"] = self._raw.topic
        if self._raw.polar and self.sonar.beam_order is not None:
            settled["beam_order"] = self.sonar.beam_order
        scale = self._images.scale
        return settled if scale is None else settled | scale.as_table()

    @property
    def notes(self) -> list[str]:
        """What is stated against the log's own messages, or was found out; complete after the
        pass."""
        return self._images.notes

    def __enter__(self) -> Log:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._raw.close()

    def __iter__(self) -> Iterator[Frame]:
        """The usable frames in order; each keeps its number in the log.

        Where frames carry no time, it is number / frame_rate_hz, or at one a second without.
        Raises SonarrecError where no frame can be used, or where the bearings in the sonar
        geometry do not match the images.
        """
        used = skipped = 0
        frames = _settled(self._raw)
        first = list(islice(frames, SETTLING_FRAMES))
        self._images.settle(first)
        frames = chain(first, frames)
        del first  # or it would keep its images to the end
        for index, raw in enumerate(frames):
            if raw.pixels is None and raw.problem is None:
                continue  # told in the faults, with others
            try:
                image, fan = self._images(raw)
                stamp = self._named(index, raw)
            except UnusableError as error:
                skipped += 1
                if skipped <= MAX_PROBLEM_LINES:
                    self.problems.append(f"{raw.name}: {error}, skipped")
                continue
            used += 1
            yield Frame(index, stamp, image, fan, raw.stamps)
        if skipped > MAX_PROBLEM_LINES:
            self.problems.append(f"{skipped - MAX_PROBLEM_LINES} more frames skipped")
        self.problems.extend(self._raw.faults)
        if not used:
            reason = f" ({self.problems[0]})" if self.problems else ""
            raise SonarrecError(f"{self.path}: not one frame could be used{reason}")

    def _named(self, index: int, raw: RawFrame) -> int:
        """The time that names a frame, ns. Raises UnusableError where the log has no such time."""
        stamps = raw.stamps
        named = {"log": raw.timestamp_ns, "publish": stamps.publish, "header": stamps.header}
        stamp = named[self._time]
        if stamp is None and self._time != "log":
            raise UnusableError(f"without a {self._time} time; --time log needs none")
        return round(index * 1e9 / (self.sonar.frame_rate_hz or 1.0)) if stamp is None else stamp

    def digest_source(self) -> tuple[int, str]:
        """(size in bytes, SHA-256 in hex) of the log's file.

        Of several images, the sum of their sizes and the hash over each one's name, a zero byte
        and its contents, in frame order. Raises SonarrecError where a file cannot be read.
        """
        size, digest = 0, hashlib.sha256()
        for path in self._files:
            if self._files != [self.path]:
                digest.update(path.name.encode(errors="surrogateescape") + b"\0")
            try:
                with path.open("rb") as file:
                    while block := file.read(2**20):
                        size += len(block)
                        digest.update(block)
            except OSError as error:
                raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
        return size, digest.hexdigest()


def open_log(
    path: str | Path,
    *,
    sonar: Sonar | None = None,
    sonar_file: Path | None = None,
    topic: str | None = None,
    time: Clock = "log",
) -> Log:
    """Open a folder of images, a glob of images, a video or an MCAP file.

    sonar: keys that win over those in files. sonar_file: in place of the sonar.toml beside the
    log (for a folder or glob `sonar.toml` beside the images; for one file `NAME.sonar.toml`, else
    `sonar.toml` in its folder). topic: the image channel of an MCAP file. time: which of the times
    in it names a frame; frames come in the order of log time whatever it is.
    Raises SonarrecError where the log or its geometry cannot be used, UsageError where the topic
    or time cannot be meant.
    """
    source = find_log(path)
    if topic is not None and not source.reader.has_topics:
        raise UsageError(f"{path}: --topic chooses a channel of an MCAP file; this is none")
    if time not in get_args(Clock):
        raise UsageError(f"{path}: time is {time!r}, not one of {', '.join(get_args(Clock))}")
    if time != "log" and not source.reader.has_topics:
        raise UsageError(f"{path}: --time chooses a clock of an MCAP file; this is none")
    resolved, where = source.stated_sonar(sonar or Sonar(), sonar_file)
    raw = source.open(topic)
    if resolved.layout is None:
        resolved = replace(resolved, layout="polar" if raw.polar else "fan")
    try:
        if not raw.polar:
            check_sonar(resolved, where)
        elif resolved.tilt_deg is None:
            raise SonarrecError(
                f"{where}: the messages tell the sonar's geometry, all but its tilt; give "
                "--tilt-deg (downward), or put tilt_deg under [sonar] into a sonar.toml beside it"
            )
    except SonarrecError:
        raw.close()
        raise
    return Log(source.path, source.name, source.files, resolved, raw, time)


@dataclass(frozen=True, slots=True)
class Source:
    """A log that was found but not opened.

    name: for the results folder. files: what it consists of, in order. reader: opens it.
    beside: where its sonar.toml may be.
    """

    path: Path
    name: str
    files: list[Path]
    reader: Reader
    beside: list[Path]

    def open(self, topic: str | None = None) -> RawLog:
        """Open it. Raises SonarrecError where it cannot be read."""
        try:
            one_file = self.files == [self.path]
            return self.reader.open(self.path, topic) if one_file else ImageFiles(self.files)
        except OSError as error:
            raise SonarrecError(f"{self.path}: cannot be read ({error.strerror})") from None

    def stated_sonar(self, flags: Sonar, sonar_file: Path | None) -> tuple[Sonar, str]:
        """The geometry as file and flags state it, and the name to give it in errors."""
        file = sonar_file or next((b for b in self.beside if b.is_file()), None)
        stated = Sonar() if file is None else load_sonar(file)
        return stated.updated(flags), str(file or self.path)


def find_log(path: str | Path) -> Source:
    """The log at a path, or of a glob. Raises SonarrecError where there is none."""
    path = Path(path)
    if not path.exists() and glob.has_magic(str(path)):
        files = _glob_images(path)
        beside = [files[0].parent / SONAR_FILE]
        name = files[0].resolve().parent.name
    elif path.is_dir():
        files = _folder_images(path)
        beside = [path / SONAR_FILE]
        name = path.resolve().name
    elif path.is_file():
        files = [path]
        beside = [path.with_name(f"{path.stem}.sonar.toml"), path.with_name(SONAR_FILE)]
        name = path.stem
    else:
        raise SonarrecError(f"{path}: no such file or folder")
    return Source(path, name or "log", files, _reader_of(files[0]), beside)


def _settled(frames: Iterable[RawFrame]) -> Iterator[RawFrame]:
    """The frames; of the first few, those of an odd size cannot be used.

    The first frame that is used settles the size of the log: one that a driver sent before it had
    its settings must not cost all the others.
    """
    frames = iter(frames)
    first = list(islice(frames, SETTLING_FRAMES))
    sizes = Counter(size for f in first if (size := _stored_size(f)) is not None)
    for frame in first:
        size = _stored_size(frame)
        if size is None or size == (usual := sizes.most_common(1)[0][0]):
            yield frame
        else:
            problem = f"{size[1]} x {size[0]} pixels in a log of {usual[1]} x {usual[0]}"
            yield replace(frame, pixels=None, problem=problem)
    yield from frames


def _stored_size(frame: RawFrame) -> tuple[int, ...] | None:
    """(rows, columns) of an image that does not tell its geometry."""
    if frame.pixels is None or frame.sonar is not None:
        return None
    return frame.pixels.shape[:2]


def _glob_images(pattern: Path) -> list[Path]:
    matches = [Path(m) for m in glob.glob(str(pattern), recursive=True)]  # noqa: PTH207
    if not matches:
        raise SonarrecError(f"{pattern}: no file matches this pattern")
    files = [m for m in matches if is_image(m) and m.is_file()]
    if not files:
        raise SonarrecError(f"{pattern}: matches no image; give a video or MCAP file by its name")
    return sorted(files, key=natural_order)


def _folder_images(folder: Path) -> list[Path]:
    try:
        entries = list(folder.iterdir())
    except OSError as error:
        raise SonarrecError(f"{folder}: cannot be read ({error.strerror})") from None
    if not entries:
        raise SonarrecError(f"{folder}: the folder is empty")
    files = [e for e in entries if is_image(e) and e.is_file()]
    if not files:
        raise SonarrecError(
            f"{folder}: no image in this folder ({', '.join(sorted(IMAGE_SUFFIXES))}); "
            "give a video or MCAP file by its name"
        )
    return sorted(files, key=natural_order)


def _reader_of(path: Path) -> Reader:
    for reader in READERS:
        if path.suffix.lower() in reader.suffixes:
            if not path.stat().st_size and reader.kind != "image":
                raise SonarrecError(f"{path}: the file is empty (zero bytes)")
            return reader
    known = ", ".join(s for reader in READERS for s in sorted(reader.suffixes))
    raise SonarrecError(
        f"{path}: not a kind of log this program reads (a folder of images, or a file: {known})"
    )
