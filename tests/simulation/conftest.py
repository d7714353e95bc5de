"""A browser, for the page of `sonarrec site`."""

from tests.report.conftest import browser  # noqa: F401
