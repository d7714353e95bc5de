"""The command line: each command is one file that parses, calls a function and prints."""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from sonarrec import __version__
from sonarrec.cli.endings import (
    INTERRUPTED,
    TERMINATED,
    Terminated,
    code_of,
    print_notes,
    terminable,
)
from sonarrec.cli.groups import advice_on, refuse_typography
from sonarrec.errors import SonarrecError, command_line, is_url, name_as_text, redact_urls

COMMANDS = (
    *("run", "info", "evaluate", "check", "report", "overlay", "export", "map"),
    *("simulate", "calibrate", "landmarks", "config", "truth", "help"),
)
"""Each is in the module of its name, and loaded where it is asked for."""
UNWRITTEN = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO, errno.EBADF}


class _Program(click.Group):
    def list_commands(self, _: click.Context) -> list[str]:
        return [*COMMANDS]

    def get_command(self, _: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        module = import_module(f"sonarrec.cli.{name}")
        command: click.Command = getattr(module, f"{name}_" if name in ("map", "help") else name)
        return command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As click's own; of an option of a command it says where that stands."""
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if error.possibilities:
                raise
            how = f"the command comes first, as in sonarrec run {error.option_name}"
            raise click.UsageError(f"{error.message.rstrip('.')}; {how}", ctx) from None

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """As click's own, with what to use in place of a command that is gone or left out."""
        word = args[0] if args else ""
        if word and word not in COMMANDS:
            refuse_typography([word], ())
            if advice := advice_on(word):
                ctx.fail(f"No such command {word!r}. {advice}")
            if os.path.lexists(word):
                how = command_line("run", Path(word))
                ctx.fail(f"{word}: a file or folder, and the command comes first, as in {how}")
        return super().resolve_command(ctx, args)

    def main(self, *arguments: Any, **options: Any) -> Any:
        logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where it has no home it says so
        _open_streams()
        return super().main(*arguments, **options)

    def invoke(self, ctx: click.Context) -> Any:
        """Faults of the input and Ctrl-C become one line; bugs keep their traceback."""
        typed = [word for word in (*ctx._protected_args, *ctx.args) if is_url(word)]
        try:
            with terminable():
                return super().invoke(ctx)
        except click.ClickException as error:
            error.message = redact_urls(error.message, typed)  # type: ignore[misc]
            raise
        except SonarrecError as error:
            print_notes([str(error)])
            ctx.exit(code_of(error))
        except KeyboardInterrupt as error:
            print_notes(["stopped"])
            ctx.exit(TERMINATED if isinstance(error, Terminated) else INTERRUPTED)
        except OSError as error:
            name = "" if error.filename is None else f"{name_as_text(error.filename)}: "
            if name or error.errno == errno.ENOENT:  # no permission, or no temporary folder
                print_notes([f"{name}{error.strerror}"])
                ctx.exit(1)
            if error.errno not in UNWRITTEN:
                raise
            # Errors of files have a file name, so this is stdout. Its buffer goes to the null
            # device, where writing cannot fail again.
            print_notes([f"stdout: cannot be written ({error.strerror})"])
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            ctx.exit(1)


def _open_streams() -> None:
    """Make stdout and stderr accept every character, and open closed streams on the null device.

    Else the next file that is opened, such as a table of results, would get the number of the
    closed stream and with it the output of libraries.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdin = sys.stdin or open(0, closefd=False)  # noqa: SIM115
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@click.group(
    cls=_Program,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 100,
        "show_default": True,
    },
)
@click.version_option(__version__, "-V", "--version", prog_name="sonarrec")
def main() -> None:
    """Recognise landmarks in recorded imaging-sonar logs, and score the results.

    `sonarrec help` lists the pages of the manual: commands, files, results, limits.

    \b
    Exit codes: 0 done; 1 failed; 2 bad usage; 3 finished, but part of the input
    could not be used; 4 worse than before, or than a limit allows (evaluate, check);
    130 and 143 stopped by Ctrl-C and SIGTERM.
    """


main.commands = dict.fromkeys(COMMANDS, click.Command(None))  # the names, to suggest one
