"""Which log is at a path, and what opens it.

A further format is one module with a RawLog and one row in READERS.
"""

from __future__ import annotations

import glob
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sonarrec.readers.images import IMAGE_SUFFIXES, ImageFiles, is_image, natural_order
from sonarrec.readers.raw import RawLog
from sonarrec.readers.video import VIDEO_SUFFIXES, VideoFrames
from sonarrec.records import SonarrecError
from sonarrec.sonar import Sonar, load_sonar

SONAR_FILE = "sonar.toml"


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
