"""Which log is at a path, and what opens it.

A further format is one module with a RawLog and one row in READERS.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from sonarrec.readers.images import IMAGE_SUFFIXES, ImageFiles, is_image, natural_order
from sonarrec.readers.raw import RawLog
from sonarrec.readers.video import VIDEO_SUFFIXES, VideoFrames
from sonarrec.records import SonarrecError, shown
from sonarrec.sonar import Sonar, load_sonar

SONAR_FILE = "sonar.toml"
_BAG = (
    "a bag of ROS {ros} is not read; make an MCAP file of it: "
    "rosbags-convert --src {{name}} --dst {{name}}.converted --dst-storage mcap"
)
_PACKED = "a compressed file is not read; unpack it first: {tool} {{name}}"
CONVERTED = {
    ".db3": _BAG.format(ros=2).replace("--src {name}", "--src the folder of {name}"),
    ".bag": _BAG.format(ros=1),
    ".zst": _PACKED.format(tool="zstd -d"),
    ".gz": _PACKED.format(tool="gunzip"),
    ".lz4": _PACKED.format(tool="lz4 -d"),
}
"""By the end of a name: what to do, in a line."""


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
            raise SonarrecError(f"{shown(self.path)}: cannot be read ({error.strerror})") from None

    def stated_sonar(self, flags: Sonar, sonar_file: Path | None) -> tuple[Sonar, str]:
        """The geometry as file and flags state it, and the name to give it in errors."""
        file = sonar_file or next((b for b in self.beside if b.is_file()), None)
        stated = Sonar() if file is None else load_sonar(file)
        return stated.updated(flags), shown(file or self.path)


def find_log(path: str | Path) -> Source:
    """The log at a path, or of a glob. Raises SonarrecError where there is none, or several."""
    path = Path(path)
    try:
        return _found(path)
    except OSError as error:  # a name beyond every limit, a folder without permission
        raise SonarrecError(f"{shown(path)[:200]}: cannot be read ({error.strerror})") from None


def find_logs(names: Iterable[str]) -> list[str]:
    """The logs that the arguments of a command name: of a glob of MCAP files or videos each that
    matches, of all else the argument itself."""
    logs: list[str] = []
    for name in names:
        try:
            is_glob = glob.has_magic(name) and not Path(name).exists()
            found = [m for m in _matches(Path(name)) if _is_log_file(m)] if is_glob else []
            logs += [str(m) for m in sorted(found, key=natural_order)] or [name]
        except OSError:  # told when it is opened
            logs.append(name)
    return logs


def _found(path: Path) -> Source:
    if not path.exists() and glob.has_magic(str(path)):
        files = _glob_images(path)
        if _is_log_file(files[0]):
            return _found(files[0])
        beside = [files[0].parent / SONAR_FILE]
        name = files[0].parent.resolve().name
    elif path.is_dir():
        files = _folder_images(path)
        beside = [path / SONAR_FILE]
        name = path.resolve().name
    elif path.is_file():
        files = [path]
        beside = [path.with_name(f"{path.stem}.sonar.toml"), path.with_name(SONAR_FILE)]
        name = path.stem
    elif path.is_symlink():
        raise SonarrecError(f"{shown(path)}: a link to a file that is not there")
    else:
        server = re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(path))
        only = "; from servers only run, info, evaluate and report read" if server else ""
        raise SonarrecError(f"{shown(path)}: no such file or folder{only}")
    return Source(path, shown(name) or "log", files, _reader_of(files[0]), beside)


def _matches(pattern: Path) -> list[Path]:
    return [Path(m) for m in glob.glob(str(pattern), recursive=True)]  # noqa: PTH207


def names_a_log(name: str) -> bool:
    """Whether a file of this name is a log by itself: of a known kind, and no image."""
    suffix = Path(name).suffix.lower()
    return any(suffix in r.suffixes for r in READERS if r.kind != "image")


def names_an_image(name: str) -> bool:
    """Whether a file of this name is taken for an image."""
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


def log_name(path: Path) -> str:
    """The name of a log: a folder's own, a file's without its ending."""
    return path.resolve().name if path.is_dir() else path.stem


def _is_log_file(path: Path) -> bool:
    return names_a_log(path.name) and path.is_file()


def _glob_images(pattern: Path) -> list[Path]:
    """The images that match, else the one log that does."""
    matches = _matches(pattern)
    if not matches:
        raise SonarrecError(f"{shown(pattern)}: no file matches this pattern")
    logs = sorted(filter(_is_log_file, matches), key=natural_order)
    files = logs or [m for m in matches if is_image(m)]
    if len(logs) > 1:
        raise SonarrecError(
            f"{shown(pattern)}: matches {len(logs)} logs, {shown(logs[0].name)} the first; "
            "open each by itself"
        )
    if not files:
        raise SonarrecError(f"{shown(pattern)}: matches no image, video or MCAP file")
    return sorted(files, key=natural_order)


def _folder_images(folder: Path) -> list[Path]:
    entries = list(folder.iterdir())
    if not entries:
        raise SonarrecError(f"{shown(folder)}: the folder is empty")
    files = [e for e in entries if is_image(e)]
    if not files:
        hint = next((h for e in sorted(entries) if (h := _hint(e))), None)
        raise SonarrecError(
            f"{shown(folder)}: no image in this folder ({', '.join(sorted(IMAGE_SUFFIXES))}); "
            + (hint or "give a video or MCAP file by its name")
        )
    return sorted(files, key=natural_order)


def _hint(path: Path) -> str | None:
    """What to do about a file of a kind that is not read but can be made into one that is."""
    ending = next((e for e in CONVERTED if path.name.lower().endswith(e)), None)
    return None if ending is None else CONVERTED[ending].format(name=shown(path.name))


def _reader_of(path: Path) -> Reader:
    for reader in READERS:
        if path.suffix.lower() in reader.suffixes:
            if reader.kind != "image" and not path.stat().st_size:
                raise SonarrecError(f"{shown(path)}: the file is empty (zero bytes)")
            return reader
    if (hint := _hint(path)) is not None:
        raise SonarrecError(f"{shown(path)}: {hint}")
    known = ", ".join(s for reader in READERS for s in sorted(reader.suffixes))
    raise SonarrecError(
        f"{shown(path)}: not a kind of log this program reads "
        f"(a folder of images, or a file: {known})"
    )
