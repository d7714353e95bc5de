"""`sonarrec truth`: convert, check, propose and review ground truth."""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from heapq import nlargest
from pathlib import Path
from typing import Any

import click

from sonarrec.cli import options
from sonarrec.cli.endings import PARTLY, finish, leave, print_notes, say
from sonarrec.cli.groups import (
    ANY,
    EXISTING,
    FILE,
    NEW_FILE,
    NUMBER,
    FiniteRange,
    GroupedCommand,
    IntegerRange,
    file_names,
    in_input,
    in_output,
    in_scoring,
)
from sonarrec.errors import SonarrecError, UsageError, number_of

NEW = "A new file; an existing one is not overwritten."
MOST_FAULTS = 20
"""Printed of one kind."""
MOST_TRACKS = 40
"""At most so many are printed; the file has all."""


@click.group(short_help="Make ground truth: propose, review, check, convert.")
def truth() -> None:
    """Ground truth: review it by eye, check a gt.csv, propose one from results, convert one.

    \b
    Examples:
      sonarrec truth review pings/
      sonarrec truth convert coco.json --log pings/
      sonarrec truth check gt.csv pings/
      sonarrec truth propose sonarrec_out/pings
    """


def _label_map(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> Any:
    labels: dict[str, int | None] = {}
    for assignment in texts:
        label, equals, landmark = assignment.rpartition("=")
        if not equals or not label or not (landmark == "none" or landmark.isdecimal()):
            raise UsageError(f"--map {assignment}: expected LABEL=ID, or LABEL=none")
        labels[label] = None if landmark == "none" else int(landmark)
    return labels


@truth.command(short_help="Write annotations as a gt.csv, or a gt.csv as COCO.", cls=GroupedCommand)
@click.argument("annotations", type=FILE)
@in_input("--log", shell_complete=file_names, help="The log that was annotated.")
@in_output(
    "--to", type=click.Choice(["gt", "coco"]), default="gt", help="What to write; coco needs --log."
)
@in_input(
    "--map labels",
    multiple=True,
    metavar="LABEL=ID",
    callback=_label_map,
    help="ID of a label, or none to leave it out; repeatable. Labels 1, ID.1 and landmark_1 need "
    "no --map.",
)
@in_input(
    "--first-frame",
    type=IntegerRange(),
    default=0,
    metavar="N",
    help="Number of the log's first frame in the images' names.",
)
@options.reading()
@options.landmarks
@options.out(NEW_FILE, f"{NEW}  [default: gt.csv; coco.json with --to coco]", ".csv", ".json")
@options.quiet
def convert(
    annotations: Path,
    log: str | None,
    to: str,
    labels: dict[str, int | None],
    first_frame: int,
    reading: dict[str, Any],
    landmarks: str | None,
    out: Path | None,
    quiet: bool,
) -> None:
    """Write ANNOTATIONS as a gt.csv, or with --to coco a gt.csv as COCO.

    ANNOTATIONS is a COCO JSON, as CVAT, Label Studio and LabelMe's converters export it. With
    --log, frames are found by image name, shapes drawn on polar images are converted to the fan,
    and `visible` is at most the share of the disc inside the fan. Exit code 3: labels or images
    that could not be used were left out.

    \b
    Examples:
      sonarrec truth convert coco.json --log pings/
      sonarrec truth convert gt.csv --log pings/ --to coco -o coco.json
      sonarrec truth convert coco.json --map "half ring=none" --map north=3 -o gt.csv
    """
    from sonarrec.readers import open_log
    from sonarrec.readers.open import find_log
    from sonarrec.results.run_file import read_run
    from sonarrec.runs.prepare import chosen_landmarks
    from sonarrec.truth.convert import convert as convert_annotations
    from sonarrec.truth.convert import truth_to_coco

    if to == "coco" and (log is None or labels or first_frame):
        raise UsageError("--to coco needs --log, and takes neither --map nor --first-frame")
    source = None if log is None else find_log(log)
    landmark_set = chosen_landmarks(source, landmarks, read_run(None))[0]
    with nullcontext() if log is None else open_log(log, **reading) as opened:
        if opened is not None and to == "coco":
            file = out or Path("coco.json")
            line, diagnostics = truth_to_coco(annotations, file, landmark_set, opened)
        else:
            file = out or Path("gt.csv")
            counts, diagnostics = convert_annotations(
                annotations, file, landmark_set, labels=labels, first_frame=first_frame, log=opened
            )
            by_id = ", ".join(f"{i} {count}" for i, count in counts.items()) or "no landmark"
            line = f"{file}: {number_of(sum(counts.values()), 'row')} ({by_id})"
    if diagnostics.problems:  # an existing file is not overwritten
        diagnostics.note(f"{file} lacks what is named above; remove it before you convert again")
    finish(quiet, [line], diagnostics.problems, diagnostics.notes)


@truth.command(short_help="Find errors in a gt.csv.", cls=GroupedCommand)
@click.argument("ground_truth", type=EXISTING, metavar="GT.CSV")
@click.argument("log", required=False, shell_complete=file_names)
@options.reading(time=True)
@options.landmarks
@in_scoring(
    "--max-pan max_pan_deg",
    type=FiniteRange(min=0, min_open=True),
    default=5.0,
    metavar="DEG",
    help="Largest turn of the sonar from one frame to the next that counts as possible.",
)
@options.quiet
def check(
    ground_truth: Path,
    log: str | None,
    reading: dict[str, Any],
    landmarks: str | None,
    max_pan_deg: float,
    quiet: bool,
) -> None:
    """Find errors in GT.CSV, the ground truth of LOG.

    GT.CSV may be a folder that holds NAME.gt.csv of each log, and LOG a folder of logs. With LOG
    alone the truth is that in or next to each log.
    It reports, with the line: IDs not in the set, frames not in the log, discs wholly outside the
    fan, `visible` outside 0 to 1 or above the share of the disc in the fan image, repeated rows,
    landmarks that overlap or change their ID, and jumps that no turn of the sonar explains.
    `overlay --ground-truth` draws it. Exit code 3: something was found.

    \b
    Examples:
      sonarrec truth check sample_data/pan.gt.csv sample_data/pan.mcap
      sonarrec truth check gt_proposed.csv pings/ --max-pan 10
      sonarrec truth check pings/
      sonarrec truth check labelled/ camp/
    """
    if log is not None and log.lower().endswith(".csv") and ground_truth.suffix.lower() != ".csv":
        raise UsageError(f"{log} and {ground_truth}: name the table first, then the log")
    from sonarrec.advice.rows import check_truth
    from sonarrec.readers import open_log
    from sonarrec.readers.open import find_log
    from sonarrec.results.run_file import read_run
    from sonarrec.runs.prepare import chosen_landmarks
    from sonarrec.truth.check import without_rows

    is_faulty, checked, unread = False, 0, list[SonarrecError]()
    pairs = _truths(ground_truth, log)
    for path, source in pairs:
        try:
            landmark_set, _ = chosen_landmarks(find_log(source), landmarks, read_run(None))
            with open_log(source, **reading) as opened:
                rows, faults, diagnostics = check_truth(
                    path, opened, landmark_set, max_pan_deg=max_pan_deg
                )
        except SonarrecError as error:  # of several logs it costs this one
            unread.append(error)
            if len(unread) == len(pairs):
                raise
            print_notes([f"{error}; not checked"])
            continue
        lines, counts = list[str](), Counter[str]()
        for fault in faults:
            counts[fault.kind] += 1
            if counts[fault.kind] <= MOST_FAULTS:
                lines.append(f"{path} line {fault.line}: {fault.text}")
        for kind, count in counts.items():
            if count > MOST_FAULTS:
                lines.append(f"... and {count - MOST_FAULTS} more of this kind: {kind}")
        checked += rows
        print_notes(diagnostics.problems)
        total = number_of(len(faults), "fault") if faults else "no fault"
        if not quiet and (rows or pairs[1:]):
            lines.append(f"{path}: {number_of(rows, 'row')}, {total}")
        say(*lines)
        print_notes((), diagnostics.notes)
        is_faulty |= bool(faults or diagnostics.problems)
    if not checked:
        raise SonarrecError(without_rows(pairs[0][0], 0, (), "nothing is checked"))
    if is_faulty or unread:
        leave(PARTLY)


def _truths(given: Path, log: str | None) -> list[tuple[Path, str]]:
    """Each truth to check, and its log. given: as GT.CSV; without a log the logs themselves. The
    truth may be a file that is not there."""
    from sonarrec.readers.named_logs import logs_of
    from sonarrec.readers.open import find_log, own_file
    from sonarrec.truth.table import TRUTH_FILE

    if log is None and given.suffix == ".csv":
        raise UsageError(f"{given}: name the log that it is the truth of, too")
    if log is not None and given.is_file():
        return [(given, log)]
    pairs = []
    for named in logs_of(log or str(given)):
        source = find_log(named.path)
        own = own_file(source.location, TRUTH_FILE).name
        truth = source.companion(TRUTH_FILE) if log is None else given / own
        pairs.append((truth or source.location.parent / own, named.path))
    return pairs


@truth.command(short_help="Propose a gt.csv from confident tracks.", cls=GroupedCommand)
@click.argument("results", type=ANY, default=Path("sonarrec_out"))
@options.method
@in_scoring(
    "--min-score",
    type=NUMBER,
    default=0.9,
    help="A track is proposed only if its best score reaches this.",
)
@in_scoring(
    "--max-gap",
    type=IntegerRange(min=0),
    default=8,
    help="Longest gap in a track that is filled in, frames.",
)
@options.out(NEW_FILE, NEW, ".csv", default=Path("gt_proposed.csv"))
@options.quiet
def propose(
    results: Path, method: str | None, min_score: float, max_gap: int, out: Path, quiet: bool
) -> None:
    """Propose a gt.csv from the confident tracks of RESULTS.

    RESULTS is the folder of one log, or one that holds several (default: sonarrec_out). A person
    must correct the proposal: look at it with `overlay --ground-truth`, add what is missing and
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
    longest = nlargest(MOST_TRACKS, tracks, key=lambda t: t.rows)
    wide = max((len(t.log) for t in longest), default=0)
    ids = max((len(f"ID.{t.landmark}") for t in longest), default=0)
    rows, proposed = sum(track.rows for track in tracks), sum(bool(t.rows) for t in tracks)
    lines = [f"{out}: {number_of(rows, 'row')} from {number_of(proposed, 'track')}"]
    for t in sorted(longest, key=lambda t: (t.log, t.frames)):
        span = f"frames {t.frames[0]}-{t.frames[1]}"
        rest = f"{number_of(t.rows, 'row')}, {t.interpolated} of them filled in"
        rest = f"left out: {t.left_out}" if t.left_out else rest
        score = f"best score {t.best_score:.3f}"
        named = f"{t.log:<{wide}}  {f'ID.{t.landmark}':<{ids}}"
        lines.append(f"  {named}  track {t.track:<4} {span:<15} {score}  {rest}")
    if more := len(tracks) - len(longest):
        lines.append(f"  these have the most rows; {number_of(more, 'more track')}")
    finish(quiet, lines, diagnostics.problems, diagnostics.notes)


@truth.command(short_help="Make a page to check and correct it by eye.", cls=GroupedCommand)
@click.argument("log", shell_complete=file_names)
@in_input(
    "--truth ground_truth",
    type=FILE,
    help="gt.csv to correct.  [default: NAME.gt.csv or gt.csv next to the log, if there is one]",
)
@in_input(
    "--results",
    type=ANY,
    help="Results of LOG, or the folder that holds them.  [default: sonarrec_out]",
)
@options.method
@in_input("--every", type=IntegerRange(min=1), default=1, help="Put every N-th frame in the page.")
@options.frame_list("Put these frames in the page.")
@in_scoring(
    "--mistakes",
    is_flag=True,
    help="Begin with the passes on which results and truth disagree, from `sonarrec evaluate`.",
)
@options.out(
    ANY,
    "The page; of a folder of logs the folder of the pages.  [default: review.html]",
    *(".html", ".htm"),
)
@options.quiet
def review(
    log: str,
    ground_truth: Path | None,
    results: Path | None,
    method: str | None,
    every: int,
    frames: list[tuple[int, int | None]] | None,
    mistakes: bool,
    out: Path | None,
    quiet: bool,
) -> None:
    """Make a page on which a person checks and corrects the truth of LOG.

    It is one HTML file for the browser, which needs no network. It shows each pass of a landmark,
    as the results and a gt.csv have it, the uncertain ones first. You accept it, reject it, give it
    another ID, drag its outline, or draw what is missing; its button Save gives NAME.gt.csv. LOG
    may be its results, or a folder of logs or of results: then each has a page, and index.html
    lists them.

    \b
    Examples:
      sonarrec truth review pings/
      sonarrec truth review pings/ --truth gt.csv --every 2 -o review.html
      sonarrec truth review pings/ --mistakes
      sonarrec truth review camp/ -o review
    """
    from sonarrec.overlays.overlay import results_in
    from sonarrec.readers.named_logs import logs_of
    from sonarrec.reports.camp import review_camp
    from sonarrec.reports.review import review as write_review

    logs = results_in(Path(log)) or [Path(named.path) for named in logs_of(log)]
    options: dict[str, Any] = {
        "truth": ground_truth,
        "results": results,
        "every": every,
        "spans": frames or (),
        "mistakes": mistakes,
        "method": method,
    }
    if logs[1:]:
        lines, diagnostics = review_camp(logs, out or Path("review"), **options)
    else:
        line, _, diagnostics = write_review(logs[0], out or Path("review.html"), **options)
        lines = [line]
    finish(quiet, lines, diagnostics.problems, diagnostics.notes)
