"""`sonarrec truth propose`: make a gt.csv from results, to be corrected by a person."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import nlargest
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonarrec.cli.endings import end, say, tell
from sonarrec.cli.groups import ANY, INPUT, NEW_FILE, SCORING, command, option
from sonarrec.cli.options import out_option, quiet_option
from sonarrec.errors import number_of

if TYPE_CHECKING:
    from sonarrec.truth.propose import ProposedTrack

MOST_TRACKS = 40
"""At most so many are printed; the file has all."""


@command(short_help="Propose a gt.csv from confident tracks.")
@click.argument("results", type=ANY, default=Path("sonarrec_out"))
@option(
    INPUT, "--method", default="framework", show_default=True, help="Method whose tracks are taken."
)
@option(
    SCORING,
    "--min-score",
    type=float,
    default=0.9,
    show_default=True,
    help="A track is proposed only if its best score reaches this.",
)
@option(
    SCORING,
    "--max-gap",
    type=click.IntRange(min=0),
    default=8,
    show_default=True,
    help="Longest gap in a track that is filled in, frames.",
)
@out_option(
    NEW_FILE,
    "A new file; an existing one is not overwritten.",
    default=Path("gt_proposed.csv"),
    show_default=True,
)
@quiet_option
def propose(
    results: Path, method: str, min_score: float, max_gap: int, out: Path, quiet: bool
) -> None:
    """Propose a gt.csv from the confident tracks of RESULTS.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). A person
    must correct the proposal: look at it with `sonarrec truth check`, add what is missing and
    remove what is wrong. Scoring the same results against an uncorrected proposal is meaningless.

    \b
    Examples:
      sonarrec truth propose sonarrec_out/pan
      sonarrec truth propose --min-score 0.95 --max-gap 0 -o gt.csv
    """
    from sonarrec.truth.propose import propose as propose_truth

    tracks, diagnostics = propose_truth(
        results, out, method=method, min_score=min_score, max_gap=max_gap
    )
    tell(diagnostics.problems)
    if not quiet:
        _print(tracks, out)
    end(diagnostics.problems)


def _print(tracks: Sequence[ProposedTrack], out: Path) -> None:
    rows, proposed = sum(track.rows for track in tracks), sum(bool(t.rows) for t in tracks)
    say(f"{out}: {number_of(rows, 'row')} from {number_of(proposed, 'track')}")
    longest = nlargest(MOST_TRACKS, tracks, key=lambda t: t.rows)
    wide = max((len(t.log) for t in longest), default=0)
    ids = max((len(f"ID.{t.landmark}") for t in longest), default=0)
    for t in sorted(longest, key=lambda t: (t.log, t.frames)):
        span = f"frames {t.frames[0]}-{t.frames[1]}"
        rest = t.left_out and f"left out: {t.left_out}"
        rest = rest or f"{number_of(t.rows, 'row')}, {t.interpolated} of them filled in"
        score = f"best score {t.best_score:.3f}"
        named = f"{t.log:<{wide}}  {f'ID.{t.landmark}':<{ids}}"
        say(f"  {named}  track {t.track:<4} {span:<15} {score}  {rest}")
    if more := len(tracks) - len(longest):
        say(f"  these have the most rows; {number_of(more, 'more track')}")
