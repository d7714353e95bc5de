"""MOTChallenge gt.txt: frame, id, left, top, width, height, considered, class, visibility."""

from __future__ import annotations

from pathlib import Path

from sonarrec.errors import SonarrecError
from sonarrec.truth.annotations.shapes import (
    HALF_A_PIXEL,
    Annotations,
    Shape,
    coordinate,
    read_text,
    whole,
)

LABELS = "labels.txt"
FEWEST = 6  # columns; some writers leave out whether a row is to be considered, and what follows
NOT_CONSIDERED = 0.001  # `visible` of a row that is not to be considered; with 0 it would be no row


def matches(path: Path, text: str) -> bool:
    """Whether a file, which begins with `text`, is a table of six numbers or more; it may have a
    header."""
    lines = text.strip().splitlines()
    try:
        numbers = [float(cell) for cell in _cells(lines[_has_header(text)])]
    except (IndexError, ValueError):
        return False
    return path.is_file() and len(numbers) >= FEWEST


def _has_header(text: str) -> bool:
    return text.lstrip()[:5].lower() == "frame"


def _cells(line: str) -> list[str]:
    return line.split(",") if "," in line else line.split()


def read(path: Path) -> Annotations:
    """Read a gt.txt. Raises SonarrecError where it is none and, with the line, on a bad one.

    The label is the class: its name in a labels.txt beside the file, else its number; where there
    is no class (six or seven columns, or -1, as in MOT15) the label is the track's id. Frames and
    boxes count from 1; but whoever writes a labels.txt (CVAT, Datumaro) counts boxes from 0.
    A row not to be considered is given so small a share in view that protocol strict ignores it.
    """
    text = read_text(path)
    if text.strip() and not matches(path, text):
        raise SonarrecError(
            f"{path}: not as MOTChallenge writes it (in each line six numbers or more, with "
            "commas or blanks between)"
        )
    labels = path.with_name(LABELS)
    names = [name.strip() for name in read_text(labels).splitlines()] if labels.is_file() else None
    origin = 0 if names else 1
    found = Annotations(first_frame=1)
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip(", \t") or (number == 1 and _has_header(line)):
            continue
        try:
            cells = [coordinate(cell) for cell in _cells(line)]
            if len(cells) < FEWEST:
                raise ValueError(f"{len(cells)} cells, where six numbers or more are expected")
            frame, track, left, top, width, height, considered = [*cells, 1.0][:7]
            kind = whole(cells[7]) if len(cells) > 7 else -1
            visible = cells[8] if len(cells) > 8 and kind != -1 else None
            if frame != int(frame) or (visible is not None and not 0 <= visible <= 1):
                raise ValueError("frames are whole numbers, visibility is a share, 0 to 1")
            if kind == -1:
                label = str(whole(track))
            elif names and not 1 <= kind <= len(names):
                raise ValueError(f"class {kind} is not in {LABELS}")
            else:
                label = names[kind - 1] if names else str(kind)
        except ValueError as error:
            raise SonarrecError(f"{path} line {number}: {error}") from None
        x = left - origin + width / 2 - HALF_A_PIXEL
        y = top - origin + height / 2 - HALF_A_PIXEL
        found.shapes.append(
            Shape(int(frame), label, x, y, visible if considered else NOT_CONSIDERED)
        )
    return found
