"""`sonarrec truth review` of several logs: a page for each, and a start page that lists them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sonarrec import __version__
from sonarrec.errors import Diagnostics, SonarrecError
from sonarrec.overlays.overlay import find_both
from sonarrec.reports.review import Summary, review
from sonarrec.reports.template import fill
from sonarrec.results.folders import log_of
from sonarrec.tables.outputs import check_output, write_page

START = "index.html"  # the start page, in the folder of the pages


def review_camp(
    logs: Sequence[Path], out: Path, *, results: Path | None = None, **options: Any
) -> tuple[list[str], Diagnostics]:
    """Write the pages of several logs into a folder; (a line on each page, faults and notes).

    options: as those of `review`. A log that cannot be used is a problem, and is named on the start
    page. Raises SonarrecError if none can be used.
    """
    check_output(out / START, "review")
    pages, failed, lines = list[Summary](), list[tuple[str, str]](), list[str]()
    parts = list[Diagnostics]()
    for log in reversed(logs):  # so that each page knows the next one
        following = pages[-1].page if pages else START
        try:
            name = log_of(find_both(log, results)[1])
            page = out / f"{name}{'_' if name.lower() == 'index' else ''}.html"
            line, summary, diagnostics = review(
                log, page, results=results, start=START, following=following, **options
            )
        except SonarrecError as error:
            failed.append((log.name, str(error)))
            diagnostics = Diagnostics()
            diagnostics.problem(str(error))
        else:
            pages.append(summary)
            lines.append(line)
        parts.append(diagnostics)
    if not pages:
        raise SonarrecError(failed[-1][1])
    together = Diagnostics()
    for diagnostics in reversed(parts):
        together.problem(*diagnostics.problems)
        together.note(*diagnostics.notes)
    summaries = [page._asdict() for page in reversed(pages)]
    write_page(
        out / START,
        fill(
            "camp.html",
            ("camp.js",),
            summaries,
            pages=summaries,
            failed=failed[::-1],
            name=out.resolve().name,
            version=__version__,
        ),
    )
    return [*reversed(lines), f"{out / START}: lists them; open it in a browser"], together
