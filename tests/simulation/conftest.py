"""A browser, for the page of `sonarrec site`."""

from tests.reports.conftest import browser  # noqa: F401
