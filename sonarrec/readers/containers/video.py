"""Reads videos through OpenCV."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2

from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.readers.decode.pixels import warnings_file, warnings_to, written
from sonarrec.readers.raw import RawLog, StoredFrame

_CUES, _CLUSTER = b"\x1c\x53\xbb\x6b", b"\x1f\x43\xb6\x75"  # elements of Matroska
_TAIL_BYTES = 2**20
_ONE_THREAD = [cv2.CAP_PROP_N_THREADS, 1]  # else a warning may come while another frame is read
VIDEO_SUFFIXES = frozenset({".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm"})


def opencv_name(path: Path) -> str:
    """A video's path for OpenCV, which takes what is before a colon for a protocol. Raises
    SonarrecError if the name is not UTF-8, because OpenCV would crash."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise SonarrecError(
            f"{path}: the name of a video must be UTF-8; choose another one"
        ) from None
    return str(path) if path.is_absolute() else f".{os.sep}{path}"


class VideoFrames(RawLog):
    """The frames of a video, timed by its container."""

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        """Raises SonarrecError if OpenCV cannot open the file as a video."""
        super().__init__(diagnostics)
        self._path, self._name = path, opencv_name(path)
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        with warnings_to(said := warnings_file()):
            self._video = cv2.VideoCapture(self._name, cv2.CAP_ANY, _ONE_THREAD)
        if not self._video.isOpened():
            with path.open("rb") as file:
                is_mp4 = file.read(8)[4:] == b"ftyp"
            if is_mp4 and b"moov atom not found" in written(said):
                raise SonarrecError(
                    f"{path}: its recorder did not finish it, so that the index (moov) is missing; "
                    "a tool for repair needs a whole video of the same camera"
                )
            raise SonarrecError(f"{path}: does not open as a video (damaged, or an unknown codec)")
        count, rate = map(self._video.get, (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
        self.frame_count = round(count) if 0 < count < 1e9 else None
        self.playback_hz = rate if 0 < rate < 1e6 else None
        self.close = self._video.release
        self._at_begin = True

    def __iter__(self) -> Iterator[StoredFrame]:
        if not self._at_begin:  # of an earlier pass
            with warnings_to(warnings_file()):
                self._video.open(self._name, cv2.CAP_ANY, _ONE_THREAD)
        self._at_begin = False
        index, last_ns, rate = 0, -1, self.playback_hz
        damaged = list[int]()
        while True:
            with warnings_to(said := warnings_file()):
                ok, pixels = self._video.grab(), None
                if ok and index not in self.passed_over:
                    ok, pixels = self._video.retrieve()
            if not ok:
                break
            if written(said):
                damaged.append(index)
            time_ns: int | None = round(self._video.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            if time_ns is not None and time_ns > last_ns:
                last_ns = time_ns
            else:  # the container states no times
                time_ns = None if rate is None else round(index * (1e9 / rate))
            yield StoredFrame(f"frame {index}", time_ns, pixels)
            index += 1
        count = self.frame_count or 0
        if damaged:
            self.diagnostics.fault(
                f"damaged inside at {number_of(len(damaged), 'frame')}, the first is {damaged[0]}; "
                "pictures from there on may be wrong",
                self._path.name,
            )
        if not index:
            four = int(self._video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("latin-1")
            self.diagnostics.fault(
                f"not one of {count} frames can be decoded here (codec {four.strip()}); convert it "
                "on a machine that plays it",
                self._path.name,
            )
        elif index < count and self._is_estimate():
            self.diagnostics.note(
                f"{index} frames read, but its length and rate give {count}: the recorder dropped "
                "some, or it is damaged; numbers of later frames may be wrong"
            )
        elif index < count:
            self.diagnostics.fault(
                f"{index} of {count} frames could be read; cut short or damaged, so the numbers of "
                "later frames may be wrong",
                self._path.name,
            )

    def _is_estimate(self) -> bool:
        """Whether this is a whole Matroska, which states its length, not how many frames it has."""
        with self._path.open("rb") as file:
            file.seek(max(file.seek(0, 2) - _TAIL_BYTES, 0))
            tail = file.read()
        ending = tail.rfind(_CUES) > tail.rfind(_CLUSTER)  # which a cut one lacks
        return self._path.suffix.lower() in (".mkv", ".webm") and ending
