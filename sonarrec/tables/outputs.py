"""Writes outputs safely.

A command never overwrites its inputs, nor files of another kind than its own. A new output replaces
an older one only when it is complete.
"""

from __future__ import annotations

import csv
import glob
import itertools
import os
import platform
import re
import shutil
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.tables import IMAGE_SUFFIXES, STREAMS

Kind = Literal[
    "report", "review", "manual", "picture", "overlay", "video", "model", "table", "JSON"
]
OVERLAY_LIBRARY = "sonarrec overlay"
"""Library name in the header of an overlay's MCAP."""
PICTURE_MARK = {"Software": "sonarrec"}
"""Metadata of our PNGs, in the form that matplotlib expects."""
MODEL_MARK = "Made by `sonarrec calibrate`"
VIDEO_MARK = struct.pack(">I4s", 24, b"free") + b"sonarrec overlay"
"""The last box of a video; players ignore it."""
_PNG_HEADER = 33
_SEVERAL = 3  # images, that are more than a figure and its older version
_numbers = itertools.count()
_HOST = re.sub(r"[^0-9A-Za-z]", "", platform.node())  # others may write into the same folder
_HEAD = 4096
_MARKS: dict[Kind, bytes] = {
    "report": b"sonarrec report</title>",
    "review": b"sonarrec review</title>",
    "manual": b"sonarrec manual</title>",
    "picture": b"Software\0sonarrec",
    "overlay": OVERLAY_LIBRARY.encode(),
    "video": VIDEO_MARK,
    "model": MODEL_MARK.encode(),
}
"""What our files of a kind have in their first bytes, or at their end. Tables and JSON are known by
how they begin."""


def check_output(
    path: Path, kind: Kind, reads: Iterable[str | Path | None] = (), *, header: str = ""
) -> None:
    """Raise UsageError if writing `path` would overwrite anything but an older output.

    kind: of the output; an existing file must be of this kind. reads: files and folders that the
    command reads; None is ignored. header: the beginning of our tables or JSON of this kind.
    """
    for source in (Path(read) for read in reads if read is not None):
        images = glob.has_magic(str(source)) and not source.exists()  # a glob of images
        log = source.parent if images else source
        if _same(path, source) or _same(path, log):
            raise UsageError(f"{path}: this command reads it; write somewhere else")
    if kind in ("picture", "overlay", "video"):
        check_distinct(path, is_image=kind == "picture")
    if not path.exists():
        above = next(parent for parent in path.parents if parent.exists())
        if not above.is_dir():
            raise UsageError(f"{path}: {above} is not a folder")
        if not os.access(above, os.W_OK | os.X_OK):
            raise SonarrecError(f"{path}: {above} may not be written to; write somewhere else")
        return
    if not path.is_dir() and not path.is_file():
        return  # a device, such as /dev/null
    with writing(path):
        is_ours = is_output(path, kind, header)
    if not is_ours:
        raise UsageError(
            f"{path}: exists and is no {kind} of sonarrec, so it is not overwritten; "
            "choose another name, or remove it first"
        )


def free_name(path: Path) -> Path:
    """The path, or if there is something already, the first free one with a number behind it."""
    full = Path(path.resolve().name)  # also of "."
    names = (path.parent / f"{full.stem}_{n}{full.suffix}" for n in itertools.count(2))
    return next(name for name in itertools.chain([path], names) if not os.path.lexists(name))


def _same(first: Path, second: Path) -> bool:
    """Whether both are the same file, possibly through a link."""
    try:
        return first.resolve() == second.resolve() or first.samefile(second)
    except OSError:  # one of them does not exist
        return False


def check_tables(folder: Path, headers: Mapping[str, Sequence[str]]) -> None:
    """`check_output` for tables in a folder. headers: file names and their columns."""
    for name, header in headers.items():
        check_output(folder / name, "table", header=",".join(header[:3]))


def below(results: Path, name: str) -> Path:
    """The path of an output of ours in a results folder.

    Raises UsageError if a link is there: only links that the user names are followed.
    """
    path = results / name
    if path.is_symlink():
        raise UsageError(f"{path}: a link, which is not followed here; remove it, or give --out")
    return path


def check_distinct(path: Path, *, is_image: bool = False) -> None:
    """Raise UsageError if an image, a video or an MCAP would become a part of a recording.

    A folder is one if it holds several images of others whose names differ in numbers alone; and
    the folder of a bag is one. is_image: of an image it is one also with a single image and a
    sonar.toml; of other outputs only with a sonar.toml, since they do not mix with photos.
    """
    folder, forms = path.parent, Counter[str]()
    is_stated = (folder / "sonar.toml").exists()
    is_recording = (folder / "metadata.yaml").exists()
    enough = 1 if is_stated and is_image else _SEVERAL
    with writing(folder):
        for image in _images_of_others(folder) if is_stated or is_image else ():
            forms[form := re.sub("[0-9]+", "#", image.name)] += 1
            if forms[form] == enough:
                is_recording = True
                break
    if is_recording:
        parts = "a bag" if not forms else f"images such as {image.name}"
        raise UsageError(
            f"{path}: {folder.resolve()} holds {parts}, of which it would become a part; write "
            "into another folder"
        )


def check_folder(folder: Path, ours: Collection[str]) -> None:
    """Raise UsageError if our files would be mixed with images of others, or go through links.

    ours: the files; if one of them exists, the folder is ours.
    """
    paths = [below(folder, name) for name in ours]
    if not any(path.exists() for path in paths):
        with writing(folder):
            other = next(_images_of_others(folder), None)
        if other is not None:
            raise UsageError(
                f"{folder}: holds {other.name}, so it may be a recording; write somewhere else"
            )


def _images_of_others(folder: Path) -> Iterator[Path]:
    """The images in a folder that are no pictures of ours. Raises OSError."""
    for file in folder.iterdir() if folder.is_dir() else ():
        is_image = file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
        if is_image and not is_output(file, "picture"):
            yield file


def _temporary(folder: Path, suffix: str = "") -> Path:
    """A free name in a folder, in which what killed processes have left is deleted."""
    _delete_left(folder.resolve())
    return folder / f".{_HOST}-{os.getpid()}-{next(_numbers)}.new{suffix}"


@cache
def _delete_left(folder: Path) -> None:
    for path in folder.glob(f".{_HOST}-*.new*"):
        process = re.fullmatch(rf"\.{_HOST}-(\d{{1,9}})-\d+\.new(\.\w+)?", path.name)
        if process is not None and not _runs(int(process[1])):
            with suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _runs(process: int) -> bool:
    """Whether a process of this number runs here, or may do so."""
    try:
        if os.name == "posix":  # elsewhere this would end it
            os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        pass
    return True


@contextmanager
def filled_at_once(folder: Path) -> Iterator[Path]:
    """A temporary folder inside `folder`, from which the files are moved there at the end, or
    deleted after an error. Raises OSError."""
    is_new = not folder.exists()
    new = _temporary(folder)
    try:
        new.mkdir(parents=True)
        yield new
        # Last: a folder without geometry is not taken for a whole recording.
        for file in sorted(new.iterdir(), key=lambda file: file.name.endswith("sonar.toml")):
            file.rename(folder / file.name)
    except OSError as error:
        error.filename = str(folder)
        raise
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if is_new:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def is_output(path: Path, kind: Kind, header: str = "") -> bool:
    """Whether a file exists that is empty or of this kind; see `check_output`. Raises OSError."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(_HEAD)
        file.seek(max(path.stat().st_size - len(VIDEO_MARK), 0))
        tail = file.read()
    if not head:
        return True  # an empty file holds nothing to lose
    if kind in ("table", "JSON"):
        return head.startswith(header.encode())
    return kind in _MARKS and _MARKS[kind] in head + tail


def is_filled(path: Path) -> bool:
    """Whether a file exists and is not empty."""
    return path.is_file() and path.stat().st_size > 0


@contextmanager
def writing(path: object) -> Iterator[None]:
    """Turn an OSError raised inside into a SonarrecError that names the file, else `path`."""
    try:
        yield
    except OSError as error:
        where = error.filename or path
        raise SonarrecError(f"{where}: cannot be written ({error.strerror})") from None


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A temporary path next to `path` that replaces it at the end, or is deleted after an error.

    Missing folders are created. For a link its target is replaced. Devices and pipes are written
    directly. An OSError names `path`.
    """
    if str(path).startswith(STREAMS) or (path.exists() and not path.is_file()):
        yield path
        return
    target = path.resolve()
    new = _temporary(target.parent, target.suffix)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            target.open("r+b").close()  # a file that is read-only must not be replaced either
            new.touch()
            shutil.copymode(target, new)
        yield new
        new.replace(target)
    except BaseException as error:
        with suppress(OSError):
            new.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(new), str(target)):
            error.filename = str(path)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8 with its line ends unchanged. Raises OSError."""
    with replaced(path) as new:
        new.write_text(text, encoding="utf-8", newline="")


def write_figure(path: Path, figure: Any, **options: Any) -> None:
    """Write a matplotlib figure as a marked PNG. look: options of savefig. Raises OSError."""
    with replaced(path) as new, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph", UserWarning)  # a box is drawn in its place
        figure.savefig(new, format="png", metadata=PICTURE_MARK, **options)


def escape_mathtext(name: str) -> str:
    """A name so that matplotlib shows it in the legend and does not read it as a formula."""
    shown = name.replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def write_csv(path: Path, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV table with our line ends. Names need not be UTF-8. Raises OSError."""
    with (
        replaced(path) as new,
        new.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file,
    ):
        table = csv.writer(file, lineterminator="\n")
        table.writerow(header)
        table.writerows(rows)


def as_cell(text: str) -> str:
    """A text that spreadsheets show as it is: no formula, and on one line."""
    text = text.replace("\r", r"\r").replace("\n", r"\n")
    return f"'{text}" if text.startswith(("=", "+", "@")) else text


def write_page(path: Path, *parts: str) -> None:
    """Write an HTML page, given in parts. Raises SonarrecError."""
    with writing(path), replaced(path) as new, new.open("w", encoding="utf-8", newline="") as file:
        file.writelines(parts)


def with_mark(png: bytes) -> bytes:
    """A PNG with PICTURE_MARK after its header."""
    [(key, value)] = PICTURE_MARK.items()
    body = b"tEXt" + key.encode() + b"\0" + value.encode()
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return png[:_PNG_HEADER] + chunk + png[_PNG_HEADER:]
