"""Drawn frames as a video or as a folder of images."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import cv2

from sonarrec.arrays import ByteImage
from sonarrec.drawing.pen import write_png
from sonarrec.errors import SonarrecError, number_of
from sonarrec.readers.containers.video import opencv_name
from sonarrec.tables.outputs import VIDEO_MARK, check_output


class VideoFile:
    """Writes pictures of one size as an MP4; use it as a context manager.

    MPEG-4 Part 2 is the most widely played format that every OpenCV writes; not all have H.264.
    """

    def __init__(self, path: Path, frame_rate_hz: float) -> None:
        """Raises SonarrecError if the name is not UTF-8."""
        self._name = opencv_name(path)
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet: faults are reported below
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        self._path = path
        # MPEG-4 divides a second into 65,535 parts at the most; players want one frame a second.
        self._rate = round(min(max(frame_rate_hz, 1.0), 60.0), 3)
        self._video: cv2.VideoWriter | None = None
        self._frames = 0

    def write(self, _: int, picture: ByteImage) -> None:
        """Append (rows, columns, 3) uint8 BGR. Raises SonarrecError where it cannot be written."""
        if self._video is None:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            rows, columns = picture.shape[:2]
            video = cv2.VideoWriter(self._name, code, self._rate, (columns, rows))
            if not video.isOpened():
                raise SonarrecError(f"{self._path}: cannot be written")
            self._video = video
        self._video.write(picture)
        self._frames += 1

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Close the file. Raises SonarrecError where it did not become a whole video."""
        if self._video is None:
            return
        self._video.release()
        with suppress(OSError), self._path.open("ab") as file:
            file.write(VIDEO_MARK)
        if kind is None:
            # OpenCV does not report a failed write.
            frames_read = cv2.VideoCapture(self._name).get(cv2.CAP_PROP_FRAME_COUNT)
            if frames_read != self._frames:
                raise SonarrecError(
                    f"{self._path}: {number_of(self._frames, 'frame')} did not become a whole "
                    "video (is the disk full?)"
                )


class ImageFolder:
    """Writes pictures as DIR/NNNNNN.png, NNNNNN the frame's number."""

    def __init__(self, folder: Path) -> None:
        """Raises SonarrecError where the folder cannot be made."""
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SonarrecError(f"{folder}: cannot be made ({error.strerror})") from None

    def __enter__(self) -> ImageFolder:
        return self

    def __exit__(self, *_: object) -> None:
        """Every picture is a whole file."""

    def write(self, number: int, picture: ByteImage) -> None:
        """Write one picture, (rows, columns, 3) uint8 BGR. Raises SonarrecError where it fails,
        UsageError where a picture of another kind is there."""
        path = self._folder / f"{number:06d}.png"
        check_output(path, "picture")
        write_png(path, picture)
