"""`sonarrec check`: run the logs of a committed file, compare them with the results on record."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from sonarrec.cli import options
from sonarrec.cli.endings import PARTLY, WORSE, leave, print_notes, say
from sonarrec.cli.groups import FOLDER, IntegerRange, command, file_names, in_batch, in_output
from sonarrec.errors import SonarrecError, UsageError, command_line, number_of

if TYPE_CHECKING:
    from sonarrec.evaluation.check_file import Check, LogToRun
    from sonarrec.evaluation.compare import Comparison, Judgement, Limits
    from sonarrec.runs.job import Job


@command(short_help="Run logs again and compare with their results on record (for CI).")
@click.argument(
    "file",
    type=click.Path(path_type=Path),
    default=Path("sonarrec.check.toml"),
    shell_complete=file_names,
)
@options.settings
@options.limits
@in_batch(
    "-j --jobs",
    type=IntegerRange(min=1),
    help="How many logs run at once.  [default: the number of cores]",
)
@in_output(
    "--update",
    is_flag=True,
    help="Record the new results, in place of those on record, whether better or worse.",
)
@options.out(
    FOLDER,
    "Folder for the new results, and for the comparison in OUT/evaluation.  [default: a temporary "
    "one]",
)
@options.quiet
def check(
    file: Path,
    settings: options.SettingsChoice,
    limits: Limits,
    jobs: int | None,
    update: bool,
    out: Path | None,
    quiet: bool,
) -> None:
    """Run the logs that FILE names, and compare the results with those on record.

    FILE (default: sonarrec.check.toml) is a small TOML file: the logs, their truth, the settings
    and what the rates must keep; `sonarrec help check` explains it. The exit code is 4 if a rate
    is worse, over all IDs in one log or of one ID or all IDs in all logs, or beyond a limit.

    \b
    Examples:
      sonarrec check --update
      sonarrec check
      sonarrec check --set features.declare=0.9
      sonarrec check tests/sonar.toml --least-tpr 0.95 -o check
    """
    from sonarrec.evaluation.check_file import LogToRun, is_recorded, names_its_log, read_check
    from sonarrec.tables.outputs import below

    spec = read_check(file)
    if update and settings != options.SettingsChoice(None, None, ()):
        raise UsageError(
            f"--update records what {file} says; write the settings there: preset, config, set"
        )
    logs, new, nameless = spec.logs(), list[LogToRun](), list[LogToRun]()
    if not update:
        new = [log for log in logs if not is_recorded(spec.record, log.name)]
        nameless = [
            log for log in logs if log not in new and not names_its_log(spec.record, log.name)
        ]
        logs = [log for log in logs if log not in (*new, *nameless)]
        again = f"{command_line('check', file, '--update')} records them; then commit them"
        print_notes(
            f"{spec.record / log.name}: run.toml does not say of which log these results are; "
            f"not compared; {again}"
            for log in nameless
        )
        if nameless and not logs:
            leave(WORSE)
        if not logs:
            raise UsageError(f"{spec.record}: no results on record yet; {again}")
        print_notes(
            f"{log.name}: no results on record in {spec.record}, not compared; {again}"
            for log in new
        )
    with ExitStack() as stack:
        folder = out or Path(stack.enter_context(TemporaryDirectory(prefix="sonarrec-check-")))
        new_path, old_path = folder.resolve(), spec.record.resolve()
        if new_path.is_relative_to(old_path) or old_path.is_relative_to(new_path):
            raise UsageError(f"{folder}: {spec.record} has the results on record; write elsewhere")
        logs, partial = _run(_jobs(spec, logs, settings, folder), logs, jobs, quiet, update)
        worse = list[str]()
        try:
            of_set = _compare(spec, logs, spec.record, folder)
        except SonarrecError as error:
            if not update:
                again = f"{command_line('check', file, '--update')} records new results"
                raise SonarrecError(f"nothing can be compared ({error}); {again}") from None
            new_alone = _compare(spec, logs, folder, folder)  # raises if no truth can be used
            unused = [line for compared in new_alone.values() for line in compared.unused]
            print_notes(unused)
            partial = partial or bool(unused)
        else:
            for name, compared in of_set.items():
                judged, target = _judge(spec, compared, limits), out and below(out, "evaluation")
                if len(of_set) > 1:
                    target = target and target / name
                    if not quiet:
                        say(f"landmarks {name}")
                _print(judged, compared, target, quiet)
                partial = partial or bool(compared.unused or (new and not update))
                worse += [] if update else judged.faults
        if update:
            _update(spec, logs, folder, quiet)
    if code := WORSE if worse or nameless else PARTLY if partial else 0:
        leave(code)


def _jobs(
    spec: Check, logs: Sequence[LogToRun], settings: options.SettingsChoice, out: Path
) -> list[Job]:
    """A job for each log. Settings of the command line change those of the file."""
    from sonarrec.runs.job import Job, RunOptions

    file = spec.file
    chosen = options.SettingsChoice(
        settings.preset or file.preset,
        settings.config_file or spec.path_to(file.config),
        (*file.set, *settings.assignments),
    )
    configs, model = chosen.configs(), spec.path_to(file.model)
    run_options = RunOptions(configs, spec.landmarks, model, chosen.config_file)
    run_options.check()
    # Run in any case: it is the program that may have changed, not the settings.
    return [
        Job(log.path, log.name, str(out), log.options, run_options, overwrite=True) for log in logs
    ]


def _run(
    to_run: list[Job], logs: Sequence[LogToRun], at_once: int | None, quiet: bool, all_needed: bool
) -> tuple[list[LogToRun], bool]:
    """Run the logs: those that have results now, and whether part of the input was not usable.

    Leaves if there are none. all_needed: raise SonarrecError if there are not all.
    """
    from sonarrec.cli.run import exit_code, run_and_print

    runs = run_and_print(to_run, to_run[0].out, quiet=quiet, briefly=True, at_once=at_once)
    done = [log for log, outcome in zip(logs, runs.outcomes, strict=True) if outcome.error is None]
    code = exit_code(runs.outcomes)
    if not done:
        leave(code)
    if all_needed and len(done) < len(logs):
        raise SonarrecError("nothing is recorded, since not every log could be run")
    return done, code != 0


def _update(spec: Check, logs: Sequence[LogToRun], folder: Path, quiet: bool) -> None:
    """Record the results, and say so."""
    from sonarrec.advice.truth import unchecked
    from sonarrec.evaluation.check_file import save
    from sonarrec.truth.table import read_truth

    for log in logs:
        table = read_truth(log.ground_truth)
        if proposed := unchecked(table, log.name):
            raise SonarrecError(f"nothing is recorded: {proposed}")
    notes = save(folder, spec.record, logs)
    print_notes([], notes)
    if not quiet:
        size = sum(f.stat().st_size for f in spec.record.rglob("*") if f.is_file())
        say(
            f"{spec.record}: the results of {number_of(len(logs), 'log')} are on record, "
            f"{size / 1e6:.1f} MB; commit them"
        )


def _compare(
    spec: Check, logs: Sequence[LogToRun], old: Path, folder: Path
) -> dict[str, Comparison]:
    """Compare the new results with old ones, those of each landmark set by themselves."""
    from sonarrec.advice.results import of_results
    from sonarrec.evaluation.compare import compare_sets
    from sonarrec.evaluation.pairs import Pair
    from sonarrec.evaluation.rows import ScoringOptions

    pairs = [Pair(folder / log.name, log.ground_truth) for log in logs]
    scoring = ScoringOptions(min_visible=spec.file.min_visible, landmarks=spec.landmarks)
    return compare_sets(old, folder, pairs, scoring, of_results)


def _judge(spec: Check, compared: Comparison, limits: Limits) -> Judgement:
    """Judge by the limits of the command line, which replace those of the file."""
    from sonarrec.evaluation.compare import EACH, Limits, judge

    file = spec.file
    least, most = (
        given if EACH in given else {**stated, **given}
        for stated, given in ((file.least_tpr, limits.least_tpr), (file.most_fpr, limits.most_fpr))
    )
    return judge(compared, Limits(file.band, least, most, file.method))


def _print(judged: Judgement, compared: Comparison, out: Path | None, quiet: bool) -> None:
    """Print the judgement and, if the results are kept, write the comparison's files into `out`."""
    from sonarrec.evaluation.compare import write_comparison
    from sonarrec.reports.screen import comparison

    print_notes(compared.unused)
    files = () if out is None else write_comparison(out, compared)
    if quiet:
        print_notes([judged.sentence] if judged.faults else [], compared.notes)
        return
    click.echo(comparison(compared, judged))
    lines = [f"note: {note}" for note in compared.notes]
    lines += [] if out is None else [f"{out}: {', '.join(files)}"]
    if lines:
        say(*lines)
