"""`sonarrec overlay`: results drawn onto the recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import finish, progress
from sonarrec.cli.groups import ANY, IntegerRange, command, file_names, in_input
from sonarrec.errors import Diagnostics, SonarrecError, UsageError, number_of

if TYPE_CHECKING:
    from sonarrec.evaluation.mistakes import Mistake
    from sonarrec.overlays.overlay import Span

Target = tuple[Path, Path | None, Sequence["Mistake"]]
"""A log or its results, its truth, and the mistakes that are to be seen."""


@command(short_help="Draw results onto the frames of their log.")
@click.argument("log", shell_complete=file_names)
@click.argument("results", type=ANY, required=False)
@options.reading()
@options.landmarks
@options.ground_truth("gt.csv, drawn dashed.")
@options.out(
    ANY,
    "What to write, by its ending: NAME.mcap (annotations for Foxglove), NAME.mp4 (a video), else "
    "a folder of images.",
    *(".mp4", ".mcap"),
    required=True,
)
@options.method
@options.frame_list("Draw these frames, in place of those of the run.")
@in_input(
    "--mistakes",
    type=IntegerRange(min=1),
    metavar="N",
    help="Draw the worst frame of each of the N longest mistakes, with the truth, as `evaluate` "
    "finds both.",
)
@options.quiet
def overlay(
    log: str,
    results: Path | None,
    reading: dict[str, Any],
    landmarks: str | None,
    ground_truth: Path | None,
    out: Path,
    method: str | None,
    frames: list[Span] | None,
    mistakes: int | None,
    quiet: bool,
) -> None:
    """Draw RESULTS onto the frames of LOG: outlines, IDs, probabilities, trails.

    RESULTS is the folder that `sonarrec run LOG` wrote, or one that holds it (default:
    sonarrec_out). RESULTS alone, in place of LOG, finds the log by its run.toml; if it holds
    several logs, each gets its folder of images in OUT. An object is outlined in the colour of its
    ID if the ID is declared, else in thin grey. Videos and images show the probabilities of each ID
    below the frame.

    Open NAME.mcap in Foxglove together with LOG, and show /sonarrec/annotations in the Image panel;
    for polar or flipped logs, folders and videos it also has the fan images, /sonarrec/fan.
    NAME.mp4 is MPEG-4 Part 2, for VLC, mpv and most desktop players. For browsers: `ffmpeg -i
    NAME.mp4 -c:v libx264 -pix_fmt yuv420p WEB.mp4`.

    \b
    Examples:
      sonarrec overlay sample_data/pan.mcap -o overlay.mcap
      sonarrec overlay pings/ -o pings.mp4 --ground-truth gt.csv
      sonarrec overlay log.mcap results/log -o shots --frames 60:90,188 --method smi
      sonarrec overlay sonarrec_out -o shots --mistakes 10
    """
    from sonarrec.overlays import overlay as overlays

    if mistakes is not None and frames is not None:
        raise UsageError("--mistakes chooses the frames; leave out --frames")
    folders = [] if results else overlays.results_in(Path(log))
    several, diagnostics, lines, faults = (
        len(folders) > 1,
        Diagnostics(),
        list[str](),
        list[SonarrecError](),
    )
    if several and out.suffix.lower() in overlays.KINDS:
        raise UsageError(
            f"{log}: results of {number_of(len(folders), 'log')}, which do not go into one file; "
            "give those of one, or a folder as -o"
        )
    targets: list[Target] = [(target, ground_truth, ()) for target in folders or [Path(log)]]
    if mistakes is not None:
        folder = Path(log) if folders else overlays.find_both(Path(log), results)[1]
        mistaken = _worst(
            folder, ground_truth, method, landmarks, reading, mistakes, diagnostics, lines
        )
        targets = [(f if folders else Path(log), t, wrong) for f, t, wrong in mistaken]
    with progress(quiet) as step:
        for target, truth, wrong in targets:
            picture = out / target.name if several else out
            try:
                report = overlays.overlay(
                    target,
                    picture,
                    results=results,
                    method=method,
                    frames=[(m.worst_frame, m.worst_frame + 1) for m in wrong] or frames,
                    ground_truth=truth,
                    landmarks=landmarks,
                    **reading,
                    observe=step,
                )
            except SonarrecError as error:
                faults.append(error)
                continue
            diagnostics.problem(*report.diagnostics.problems)
            diagnostics.note(*report.diagnostics.notes)
            lines.append(f"{picture}: {number_of(report.frames, 'frame')}, {report.method}")
            lines += [f"  frame {m.worst_frame}: {m.in_words}; {m.span}" for m in wrong]
    if faults and not lines:
        raise faults[0]
    diagnostics.problem(*(f"{error}; not drawn" for error in faults))
    finish(quiet, lines, diagnostics.problems, diagnostics.notes)


def _worst(
    results: Path,
    truth: Path | None,
    method: str | None,
    landmarks: str | None,
    reading: dict[str, Any],
    most: int,
    diagnostics: Diagnostics,
    lines: list[str],
) -> list[Target]:
    """The longest mistakes of a method, at most `most` in all: (results, truth, mistakes) of each
    log that has one. lines: gets one if there is none."""
    from sonarrec.advice.results import of_results
    from sonarrec.evaluation.evaluate import evaluate_logs
    from sonarrec.evaluation.rows import ScoringOptions
    from sonarrec.sonar.stated import load_sonar

    file = reading["sonar_file"]
    evaluation = evaluate_logs(
        results,
        truth,
        ScoringOptions(
            landmarks=landmarks,
            sonar=load_sonar(file) if file else None,
            methods=(method,) if method else (),
        ),
        of_results,
    )
    diagnostics.problem(*evaluation.unused)
    first = evaluation.counts.methods[0]
    of_first = [m for m in evaluation.counts.mistakes if m.method == first]
    wrong = [m for m in of_first if not m.at_start][:most]
    if not wrong:
        but = " but in the first frame, in which no track is declared" if of_first else ""
        lines.append(f"{first}: no mistake{but}, so nothing is drawn; --method chooses another")
    logs = zip(evaluation.folders, evaluation.truths, evaluation.counts.logs, strict=True)
    targets = [(f, t, [m for m in wrong if m.log == log]) for f, t, log in logs]
    return [target for target in targets if target[-1]]
