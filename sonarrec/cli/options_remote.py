"""Options for servers: URLs in place of paths, and the cache."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from sonarrec.cli.groups import FOLDER, INPUT, as_one, option


class _OrUrl(click.Path):
    """A local path as in click.Path, or a URL as text."""

    def convert(self, value: Any, *context: Any) -> Any:
        from sonarrec.remote.urls import is_url

        return str(value) if is_url(value) else super().convert(value, *context)


FILE_OR_URL = _OrUrl(exists=True, dir_okay=False, path_type=Path)
NEW_FILE_OR_URL = _OrUrl(dir_okay=False, path_type=Path)
FOLDER_OR_URL = _OrUrl(file_okay=False, path_type=Path)
ANY_OR_URL = _OrUrl(path_type=Path)


def _bytes(_: click.Context, __: click.Parameter, size: str) -> int:
    """The bytes of a size. Raises UsageError if it is invalid."""
    from sonarrec.remote.cache import size_bytes

    return size_bytes(size)


_CACHE = {
    "cache_folder": option(
        INPUT,
        "--cache",
        "cache_folder",
        type=FOLDER,
        help="Folder for logs and results fetched from s3://, gs://, https:// and sftp://.  "
        "[default: sonarrec in the user's cache folder]",
    ),
    "cache_size": option(
        INPUT,
        "--cache-size",
        callback=_bytes,
        metavar="SIZE",
        default="20GB",
        show_default=True,
        help="Maximum size of the cache; the least recently used logs are deleted first.",
    ),
}


@dataclass(frozen=True, slots=True)
class CacheChoice:
    """The cache as given on the command line."""

    values: Mapping[str, Any]

    def cache(self) -> Any:
        """The Cache. Raises SonarrecError if its default folder cannot be found."""
        from sonarrec.remote.cache import Cache, default_folder

        folder = self.values["cache_folder"] or default_folder()
        return Cache(folder.resolve(), self.values["cache_size"])


cache_options = as_one("cache", _CACHE, CacheChoice)
