"""`sonarrec landmarks`: how well the IDs of a landmark set can be distinguished."""

from __future__ import annotations

import math
from pathlib import Path

import click

from sonarrec.cli import options
from sonarrec.cli.endings import print_notes, say
from sonarrec.cli.groups import NEW_FILE, FiniteRange, command, file_names, in_geometry
from sonarrec.errors import UsageError, number_of


@command(short_help="Show a landmark set, and how much its IDs differ.")
@click.argument("landmark_set", metavar="SET", default="basin", shell_complete=file_names)
@in_geometry(
    "--distance distance_m",
    metavar="M",
    type=FiniteRange(0, 1e4),
    default=3.0,
    help="Distance of the landmarks from the sonar, m.",
)
@in_geometry(
    "--beam-width beam_width_deg",
    metavar="DEG",
    type=FiniteRange(0, 30),
    default=0.6,
    help="Width of a beam between half-power points, deg; run.toml has that of a log.",
)
@options.out(
    NEW_FILE,
    "Draw every disc or plate, as drawn and as the beams show it, into this PNG. An SVG: a sheet, "
    "to scale, to cut plates from.",
    *(".png", ".svg"),
)
@options.quiet
def landmarks(
    landmark_set: str, distance_m: float, beam_width_deg: float, out: Path | None, quiet: bool
) -> None:
    """Print how much the IDs of a landmark set differ, and what makes them hard to recognise.

    SET is a TOML file or a built-in name (default: basin). The difference of two IDs is the share
    of the symbol's area (of a drawn plate's cells) in which they differ, at the rotation at which
    they differ least: as drawn, and as seen by a sonar whose beams smear them.

    \b
    Examples:
      sonarrec landmarks
      sonarrec landmarks my_set.toml --distance 8 --beam-width 1 -o my_set.png
      sonarrec landmarks actag24h10 -o plates.svg
    """
    from sonarrec.advice.landmarks import of_landmarks
    from sonarrec.drawing.landmarks import SHEET_MARK, distances, draw_landmarks, sheet
    from sonarrec.drawing.pen import write_png
    from sonarrec.landmarks import DrawnSet, load_landmarks
    from sonarrec.tables.outputs import check_output, write_text

    chosen = load_landmarks(landmark_set)
    drawn = isinstance(chosen, DrawnSet)
    if out is not None:
        if out.suffix.lower() not in (".png", ".svg"[: 4 * drawn]):
            also = ", or in .svg for a sheet to cut plates from" if drawn else ""
            raise UsageError(f"--out {out}: the name must end in .png{also}")
        if out.suffix.lower() == ".svg":
            check_output(out, "table", [landmark_set], header=SHEET_MARK)
        else:
            check_output(out, "picture", [landmark_set])
    beam_m = distance_m * math.radians(beam_width_deg)
    pairs = distances(chosen, beam_m)
    advice = of_landmarks(chosen, beam_m, pairs)
    if out is not None and isinstance(chosen, DrawnSet) and out.suffix.lower() == ".svg":
        write_text(out, sheet(chosen))
    elif out is not None:
        write_png(out, draw_landmarks(chosen, beam_m))
    if not quiet:
        beams = f"beams {1000 * beam_m:.0f} mm wide ({beam_width_deg:g} deg)"
        what = "plates" if drawn else "discs"
        size = f"{number_of(len(chosen.ids), 'ID')}, {what} of {2 * chosen.radius_m:g} m"
        sides = {len(d) for d in chosen.drawings()} if isinstance(chosen, DrawnSet) else set()
        cells = sides.pop() ** 2 if len(sides) == 1 else 0

        def shown(share: float) -> str:
            return f"{share * cells:.0f} of {cells}" if cells else f"{share:.2f}"

        say(f"{chosen.name}: {size}", f"  at {distance_m:g} m, with {beams}")
        if pairs:
            say("  IDs          as drawn   as seen")
        for d in pairs:
            ids = f"{d.ids[0]} and {d.ids[1]}"
            say(f"  {ids:<12} {shown(d.drawn):>8}  {d.seen:>8.2f}")
        if out is not None:
            say(f"{out}: drawn")
    print_notes([], [f"{landmark_set}: {line.text}" for line in advice])
