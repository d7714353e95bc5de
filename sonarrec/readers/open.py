"""Finds the log at a path, the reader that opens it, and the files that belong to it.

To add a format, write one module with a RawLog (or a Recording, for messages on channels) and add
one row to READERS.
"""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

from sonarrec.errors import (
    Diagnostics,
    MissingError,
    SonarrecError,
    UsageError,
    command_line,
    name_as_text,
    similar_name,
)
from sonarrec.landmarks import load_landmarks
from sonarrec.readers.containers.bag_folder import BagFolder, bag_files, is_bag_folder
from sonarrec.readers.containers.ddf import DdfFrames
from sonarrec.readers.containers.gemini import GeminiPings
from sonarrec.readers.containers.images import ImageFiles, ImagePaths, is_array, is_image
from sonarrec.readers.containers.oculus import OculusPings
from sonarrec.readers.containers.video import VIDEO_SUFFIXES, VideoFrames
from sonarrec.readers.raw import RawLog, Recording
from sonarrec.sonar.stated import Sonar, load_sonar
from sonarrec.tables import (
    ARRAY_SUFFIX,
    IMAGE_SUFFIXES,
    PART,
    kind_of,
    natural_order,
    something_else,
)
from sonarrec.tables.outputs import is_output
from sonarrec.tables.toml import read_toml

SONAR_FILE = "sonar.toml"
LANDMARKS_FILE = "landmarks.toml"
SHARED = frozenset({SONAR_FILE, LANDMARKS_FILE})
"""Files of a sonar and a site, which serve several logs; they may lie next to a log's folder."""


Open = Callable[[Sequence[Path], Diagnostics], RawLog]


def _recorded(module: str, name: str) -> Callable[[Path, Diagnostics], Recording]:
    """A class of `containers`, whose libraries are loaded only where it is needed."""
    full_name = f"sonarrec.readers.containers.{module}"
    return lambda path, diagnostics: getattr(import_module(full_name), name)(path, diagnostics)


def _file(kind: Callable[[Path, Diagnostics], RawLog]) -> Open:
    """The reader of a log that is one file."""
    return lambda files, diagnostics: kind(files[0], diagnostics)


@dataclass(frozen=True, slots=True)
class Reader:
    """One kind of log: how its names end, and what opens it. Either open or recording is given."""

    kind: str
    suffixes: frozenset[str]
    open: Open | None = None
    """Takes the list of files."""
    recording: Callable[[Path, Diagnostics], Recording] | None = None
    """For messages on channels; takes the log's path. Both also take the Diagnostics that receive
    faults."""
    is_zip: bool = False
    """Whether such a file may be a ZIP."""

    @property
    def has_topics(self) -> bool:
        """Whether the log has channels, of which one can be chosen."""
        return self.recording is not None


_IMAGES = Reader("image", IMAGE_SUFFIXES, ImageFiles)
_ARRAYS = Reader("image", frozenset({ARRAY_SUFFIX}), ImageFiles)
_BAG_FOLDER = Reader(
    "ROS 2 bag",
    frozenset(),
    recording=lambda path, diagnostics: BagFolder(path, open_recording, diagnostics),
)
READERS = (
    _IMAGES,
    _ARRAYS,
    Reader("video", VIDEO_SUFFIXES, _file(VideoFrames)),
    Reader("MCAP", frozenset({".mcap"}), recording=_recorded("mcap", "McapRecording")),
    Reader("ROS 2 bag (SQLite)", frozenset({".db3"}), recording=_recorded("db3", "Db3Recording")),
    Reader("ROS 1 bag", frozenset({".bag"}), recording=_recorded("ros_bag", "RosBag")),
    _BAG_FOLDER,
    Reader("ARIS", frozenset({".aris"}), _file(DdfFrames)),
    Reader("DIDSON", frozenset({".ddf"}), _file(DdfFrames)),
    Reader("Oculus", frozenset({".oculus", ".raw"}), _file(OculusPings)),
    Reader("Gemini", frozenset({".glf"}), _file(GeminiPings), is_zip=True),
)
_ENDINGS = {suffix: reader for reader in READERS for suffix in sorted(reader.suffixes)}
_LOG_ENDINGS = tuple(e for e, reader in _ENDINGS.items() if reader not in (_IMAGES, _ARRAYS))
_NOT_READ: dict[str | bytes, str] = {
    **{".mbez": "Blueye", ".bin": "Ping Viewer (Ping360)", ".svlog": "Cerulean"},
    **{".imb": "Imagenex", ".ecd": "Tritech", ".son": "BlueView"},
    **{b"XML0": "an EK80", b"CON0": "an EK60", b"RIP1": "a 3D-15", b"RIP2": "a 3D-15"},
}
"""Recordings of others, by their ending or a mark in their first bytes."""
_COMPANIONS = (
    *("", ".toml", ".csv", ".tsv", ".txt", ".md", ".json", ".yaml", ".yml", ".xml", ".html"),
    *(".pdf", ".xlsx", ".ods", ".docx", ".log", ".py", ".ipynb", ".sh", ".svg", ".geojson"),
)
"""Endings of files that are kept together with recordings, and are none."""


@dataclass(frozen=True, slots=True)
class Source:
    """A log that was found but not opened yet."""

    path: Path
    name: str
    """Of its results folder."""
    files: Sequence[Path]
    """All its files, in order."""
    reader: Reader
    diagnostics: Diagnostics
    """Faults and notes about the log."""
    up_to: Path | None = None
    """The highest folder searched for files that belong to the log; None: only the folder in which
    it lies."""

    @property
    def location(self) -> Path:
        """The log's file or folder; for a glob of images, their folder."""
        return self.path if self.path.exists() else self.files[0].parent

    def companion(self, name: str) -> Path | None:
        """A file that belongs to the log, such as its sonar.toml; None if there is none."""
        return companion(self.location, name, self.up_to)

    def check_topic(self, topic: str | None, where: str | Path) -> None:
        """Raise UsageError if a topic is given but the log has none. where: the log as given."""
        if topic is not None and not self.reader.has_topics:
            raise UsageError(
                f"{where}: --topic chooses a channel of an MCAP or a ROS bag; this log is neither"
            )

    def open(self, topic: str | None = None) -> RawLog:
        """Open the log. Raises SonarrecError if it cannot be read."""
        if self.reader.open is None:
            from sonarrec.readers.messages.images import ChannelImages

            return ChannelImages(self.recording(), topic)
        try:
            return self.reader.open(self.files, self.diagnostics)
        except OSError as error:
            raise SonarrecError(f"{self.path}: cannot be read ({error.strerror})") from None

    def recording(self) -> Recording:
        """Open the log as messages on channels. Raises SonarrecError if it cannot be read."""
        # If a glob matches one file, that file is the log; a bag is its folder.
        file = self.path if self.reader is _BAG_FOLDER else self.files[0]
        return open_recording(file, self.diagnostics, self.reader)

    def stated_sonar(self, flags: Sonar, sonar_file: Path | None) -> tuple[Sonar, str]:
        """(the geometry that file and flags state, its name in error messages). Raises UsageError
        if the file is invalid, or what is stated contradictory."""
        file = sonar_file or self.companion(SONAR_FILE)
        stated = Sonar() if file is None else load_sonar(file)
        # Bearings take precedence over a field of view, but flags take precedence over the file.
        is_fan = (flags.layout or stated.layout) == "fan"
        if is_fan and flags.field_of_view_deg is not None and flags.bearings_deg is None:
            stated = replace(stated, bearings_deg=None)
        if flags.bearings_deg is not None:
            stated = replace(stated, field_of_view_deg=None)
        stated = stated.updated(flags)
        where = name_as_text(file or self.path)
        stated.check_stated(flags, where)
        return stated, where


def open_recording(path: Path, diagnostics: Diagnostics, reader: Reader | None = None) -> Recording:
    """Open a bag's folder or one file of messages. Raises SonarrecError if it is another kind or
    cannot be read."""
    try:
        reader = reader or _reader_of(path)
        if reader.recording is None:
            raise SonarrecError(f"{path}: not a file of messages")
        return reader.recording(path, diagnostics)
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None


def find_log(path: str | Path, up_to: Path | None = None) -> Source:
    """Find the log at a path, or the images or the one log that a glob matches. up_to: see Source.
    Raises SonarrecError if there is no log, or several."""
    path = Path(path)
    try:
        return _find(path, up_to)
    except OSError as error:  # a name beyond every limit, a folder without permission
        raise SonarrecError(f"{str(path)[:200]}: cannot be read ({error.strerror})") from None


def companion(log: Path, name: str, up_to: Path | None = None) -> Path | None:
    """The file `name` that belongs to a log (a file or folder); None if there is none. Searched in
    this order: LOG.name and then name, next to a file or inside a folder; LOG.name next to a
    folder; both in the folders above, up to and with `up_to`; one of SHARED next to a folder."""
    own_name = own_file(log, name).name
    folder = log if log.is_dir() else log.parent
    candidates = [folder / own_name, folder / name]
    parent = log.parent if log.name not in ("", "..") else log.resolve().parent
    if folder == log:
        candidates.append(parent / own_name)
    if up_to is not None and up_to.resolve() in folder.resolve().parents:
        for above in folder.resolve().relative_to(up_to.resolve()).parents:
            candidates += [up_to / above / own_name, up_to / above / name]
    elif folder == log and name in SHARED:
        candidates.append(parent / name)
    return next(filter(os.path.isfile, candidates), None)


def misnamed(log: Path, name: str, used: Path | None = None) -> str:
    """A geometry or landmark set next to a log that is not called as one, as the end of a message;
    empty: none. name: SONAR_FILE or LANDMARKS_FILE. used: what is in its place; if several logs may
    share that, only files whose names begin as the log's count."""
    if used is not None and (used.name != name or used.parent == log):
        return ""
    what, load = {SONAR_FILE: ("geometry", load_sonar)}.get(name, ("landmark set", load_landmarks))
    word, folder, own = name.partition(".")[0].rstrip("s"), log.parent, own_file(log, name).name
    if log.is_dir():
        folder, own = log, name
    for path in sorted({*folder.glob("*.toml*"), *folder.glob("*.txt")}):
        is_named = used is None and word in path.name.lower()
        if not (is_named or path.name.startswith(log_name(log))):
            continue  # pictures may have a text file each
        with suppress(SonarrecError):
            if not path.name.endswith((f".{name}", "run.toml")) and path != used and load(path):
                return f"; {path.name} has a {what}: call it {own}"
    return ""


def misspelt(log: Path, name: str, used: Path | None = None) -> str:
    """A file in the log's folder that is called `name` but for capitals, a second ending or the
    number of a download, as the end of a message; empty: none, or none newer than `used`."""
    folder, own = log if log.is_dir() else log.parent, own_file(log, name).name
    stem, _, ending = name.partition(".")
    may = "" if used is not None and used.name == own else "?"  # one without NAME is another log's
    form = rf"({re.escape(log_name(log))}\.){may}{stem}( ?\(\d+\))?\.{ending}(\.txt|\.{ending})?"
    for path in folder.glob("*.*"):
        is_similar = re.fullmatch(form, path.name, re.IGNORECASE) and path.is_file()
        if path.name in (name, own) or not is_similar:
            continue
        if used is None:
            return f"; {path.name} is there: call it {own}"
        if path.stat().st_mtime_ns > used.stat().st_mtime_ns:
            return f"; {path.name} is newer: call it {own} if it is meant, else delete it"
    return ""


def own_file(log: Path, name: str) -> Path:
    """Where the file `name` of this log alone would be: in the same folder, called LOG.name."""
    return log.parent / f"{log_name(log)}.{name}"


def log_name(path: Path) -> str:
    """The name of a log: that of a folder, or of a file without its ending."""
    if os.path.isdir(path):  # noqa: PTH112 - Path.is_dir raises where permission is lacking
        return path.resolve().name
    ending = next((e for e in _ENDINGS if path.name.lower().endswith(e)), path.suffix)
    return path.name[: len(path.name) - len(ending)]


def names_a_log(name: str) -> bool:
    """Whether a file of this name is a log by itself: a known kind other than an image.
    LICENSE.sample.aris is none: it is the licence of another file."""
    about = re.match(r"(licen[cs]e|readme|copying|notice)\b", name, re.IGNORECASE)
    return about is None and name.lower().endswith(_LOG_ENDINGS)


def is_log_file(path: Path) -> bool:
    """Whether a path is a file that is a log by itself, or a link to a missing one. The link is
    reported when it is opened; skipping it would hide that the log is missing."""
    return names_a_log(path.name) and (path.is_file() or (path.is_symlink() and not path.exists()))


def matches(pattern: str | Path) -> list[Path]:
    """The paths that a glob matches. ** stands for any folders, a final slash for folders only. A
    folder that is there is meant as it is named."""
    root = next((p for p in Path(pattern).parents if os.path.isdir(p)), Path())  # noqa: PTH112
    rest = f"{Path(pattern).relative_to(root)}{'/' if str(pattern).endswith('/') else ''}"
    names = glob.glob(rest, root_dir=root, recursive=True)  # noqa: PTH207
    return [root / match for match in names]


def _find(path: Path, up_to: Path | None) -> Source:
    files: Sequence[Path]
    about = Diagnostics(path)
    if not path.exists() and glob.has_magic(str(path)):
        files, reader = _glob_images(path), _IMAGES
        if is_log_file(files[0]):
            return _find(files[0], up_to)
        name = files[0].parent.resolve().name
    elif path.is_dir():
        name, reader = path.resolve().name, _IMAGES
        if is_bag_folder(path):
            files, reader = bag_files(path), _BAG_FOLDER
        else:
            files, others = (ImagePaths(filter(f, path.iterdir())) for f in (is_image, is_array))
            if len(others) > len(files):
                files, others, reader = others, files, _ARRAYS
            if len(others) > (reader is _IMAGES):  # a single array is perhaps of times
                more = ", nor others of its kind" if len(others) > 1 else ""
                about.note(
                    f"{others[0].name} is not read{more}: the log is the {len(files)} files as "
                    f"{files[0].name}"
                )
        if not files or (reader is _ARRAYS and any(map(is_log_file, path.iterdir()))):
            raise MissingError(_why_no_log(path))
    elif path.is_file():
        files, name, reader = [path], log_name(path), _reader_of(path)
    elif path.exists():  # a device, a pipe
        raise UsageError(f"{path}: neither a file nor a folder")
    elif path.is_symlink():
        raise SonarrecError(f"{path}: a link to a file that is not there")
    else:
        server = re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(path))
        only = "; only `run` reads from servers" if server else ""
        raise MissingError(f"{path}: no such file or folder{only or similar_name(path)}")
    return Source(path, results_name(name), files, reader, about, up_to)


def _glob_images(pattern: Path) -> Sequence[Path]:
    """The one log that matches, or else the images."""
    paths = matches(pattern)
    if not paths:
        raise MissingError(f"{pattern}: no file matches this pattern")
    logs = sorted(filter(is_log_file, paths), key=natural_order)
    files = logs or ImagePaths([*filter(is_image, paths)] or filter(is_array, paths))
    if len(logs) > 1:
        raise SonarrecError(
            f"{pattern}: matches {len(logs)} logs, {logs[0].name} the first; open each by itself"
        )
    if not files:
        raise SonarrecError(f"{pattern}: matches no image, video, MCAP or ROS bag")
    return files


def _why_no_log(folder: Path) -> str:
    """Why a folder is no log."""
    entries = list(folder.iterdir())
    for candidate in (folder, *entries):
        if all(os.access(candidate / name, os.R_OK) for name in ("run.toml", "frames.csv")):
            shown = command_line("report", folder)
            log = read_toml(candidate / "run.toml").get("input", {}).get("path")
            its_log = f"; the log is {log}" if isinstance(log, str) and candidate == folder else ""
            return f"{folder}: this is a folder of results, not a log; {shown} shows them{its_log}"
    if logs := sorted(filter(is_log_file, entries), key=natural_order):
        return (
            f"{folder}: a folder of {len(logs)} logs, {logs[0].name} the first; open each by itself"
        )
    endings = ", ".join(sorted(IMAGE_SUFFIXES))
    below = any(is_image(path) or names_a_log(path.name) for path in folder.rglob("*"))
    how = "; --recursive looks into those below" if below else ", nor in those below"
    held = f"; it holds {held}" if (held := not_read(entries)) else ""
    why = f"no log and no image in this folder ({endings}){how}{held}"
    return f"{folder}: {why if entries else 'the folder is empty'}"


def not_read(entries: Iterable[Path]) -> str:
    """How many files of each ending may be recordings, and are not read; empty if none is."""
    shown = (path for path in entries if path.name[0] != "." and path.is_file())
    endings = Counter(path.suffix.lower() for path in shown)
    for ending in {*_ENDINGS, *_COMPANIONS} & {*endings}:
        del endings[ending]
    return ", ".join(f"{count} {ending}" for ending, count in endings.most_common())


def results_name(name: str) -> str:
    """The name of the results of a log: valid on this disk, and not that of an unfinished run."""
    try:
        os.fsencode(text := name_as_text(name))
    except UnicodeEncodeError:  # the locale lacks a letter, so the bytes are used as they are
        text = name
    if text.endswith(PART):  # a run of a log without this ending would overwrite it
        return f"{text}_"
    text = re.sub(r"[\x00-\x1f\x7f]", "_", text)
    return "log" if text in ("", ".", "..") else text


def _reader_of(path: Path) -> Reader:
    name = path.name.lower()
    reader = next((reader for ending, reader in _ENDINGS.items() if name.endswith(ending)), None)
    with path.open("rb") as file:
        head = file.read(32)
    if (what := something_else(head)) and not (reader and reader.is_zip and head[:2] == b"PK"):
        raise SonarrecError(f"{path}: {what}")
    for mark in (path.suffix.lower(), head[:4], head[4:8]):
        if mark in _NOT_READ:
            how = "export images, a video or an MCAP (sonarrec help formats)"
            raise SonarrecError(f"{path}: a recording of {_NOT_READ[mark]}, not read here; {how}")
    if reader is None:
        if path.suffix.lower() == ".csv":
            raise SonarrecError(
                f"{path}: a table, not a log; a ground truth lies next to its log or is given with "
                "--ground-truth"
            )
        raise SonarrecError(
            f"{path}: not a kind of log this program reads "
            f"(a folder of images or a ROS 2 bag, or a file: {', '.join(_ENDINGS)})"
        )
    if (kind := kind_of(head)) in ("image", "video") and kind != reader.kind:
        raise SonarrecError(
            f"{path}: its name is that of the kind {reader.kind}, but what it holds is of the kind "
            f"{kind}; rename it by what it holds"
        )
    if head and is_output(path, "video"):
        raise SonarrecError(
            f"{path}: a video that `sonarrec overlay` made, not a log; give its log"
        )
    if reader is not _IMAGES and not head:
        raise SonarrecError(f"{path}: the file is empty (zero bytes)")
    return reader
