"""URLs of logs and results: parsed, built, and written without their secrets."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeVar
from urllib.parse import quote, unquote, urlsplit

from sonarrec.errors import UsageError, name_as_text

Place = TypeVar("Place")
SCHEMES = ("s3", "gs", "https", "http", "sftp")
HIDDEN = "***"
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/{1,2}(?=[^/])")  # a Path keeps one slash only
# A quoted slash would separate folders, and a bare plus means a space to some servers. %252F is the
# text %2F, and so on.
_KEPT = re.compile(r"(?i)(%(?:25)*2[BF])")
_SAFE = "/!~@:+,;=&$'()"
_LEAST = 4  # characters; shorter secrets are not searched for in error texts
_LOGIN_OR_QUERY = re.compile(r"(?<=://)[^/\s@]*@|(?<=\?)[^\s'\"]+")


@dataclass(frozen=True, slots=True)
class Url:
    """A place on a server.

    front: "s3://" or "https://user:password@host". path: "bucket/dives/a.mcap" or "/dives/a.mcap",
    quoted for a web server only. query: of a web URL, with its question mark.
    literal: * ? [ in the path are part of names, not wildcards.
    """

    scheme: str
    front: str
    path: str
    query: str = ""
    literal: bool = field(default=False, compare=False)

    def __str__(self) -> str:
        """The URL with its secrets: for servers only, never for messages or files."""
        return f"{self.front}{self.path}{self.query}"

    @property
    def is_web(self) -> bool:
        return self.scheme in ("http", "https")

    @property
    def plain_path(self) -> str:
        """The path unquoted, but for slashes and pluses."""
        return _changed(self.path, unquote) if self.is_web else self.path

    @property
    def name(self) -> str:
        """The last part of the path; for the root the host name."""
        last = self.plain_path.rstrip("/").rpartition("/")[2]
        return last or urlsplit(self.front).hostname or "log"

    @property
    def parent(self) -> Url:
        return replace(self, path=self.path.rstrip("/").rpartition("/")[0])

    def child(self, relative: str) -> Url:
        """The URL of an unquoted path below, with the same query, which may hold a key."""
        path = _changed(relative, lambda part: quote(part, _SAFE)) if self.is_web else relative
        path = f"{self.path.rstrip('/')}/{path}"
        return replace(self, path=path.lstrip("/") if self.scheme in ("s3", "gs") else path)

    @property
    def redacted(self) -> str:
        """The URL for messages and files: the password and every value of the query are hidden."""
        pairs = [pair.partition("=") for pair in self.query.removeprefix("?").split("&") if pair]
        query = "&".join(f"{key}={HIDDEN}" if equals else HIDDEN for key, equals, _ in pairs)
        return self.place + (f"?{query}" if query else "")

    @property
    def place(self) -> str:
        """`redacted` without a query."""
        scheme, _, rest = self.front.partition("://")
        user, at, host = rest.rpartition("@")
        if at:
            name, colon, _ = user.partition(":")
            # A web user without a password is a token.
            user = f"{name}:{HIDDEN}" if colon else HIDDEN if self.is_web else name
        return name_as_text(f"{scheme}://{user}{at}{host}{self.path}")

    def hide(self, text: str) -> str:
        """A text such as an error message without this URL's secrets."""
        text = text.replace(str(self), self.redacted)
        user = self.front.partition("://")[2].rpartition("@")[0]
        values = [pair.partition("=") for pair in self.query.removeprefix("?").split("&")]
        secrets = {user.partition(":")[2], *(value or key for key, _, value in values)}
        secrets |= {unquote(secret) for secret in secrets}
        for secret in sorted(secrets, key=len, reverse=True):
            if len(secret) >= _LEAST:
                text = text.replace(secret, HIDDEN)
        return _LOGIN_OR_QUERY.sub(lambda found: HIDDEN + "@" * found[0].endswith("@"), text)


def _changed(path: str, change: Callable[[str], str]) -> str:
    """A path of a web URL, changed except for its quoted slashes and pluses."""
    parts = _KEPT.split(path)
    return "".join(part if n % 2 else change(part) for n, part in enumerate(parts))


def is_url(text: object) -> bool:
    """Whether a text is a URL, also after it was turned into a Path and back."""
    return _URL.match(str(text)) is not None


def local(place: Place) -> Place:
    """The place itself. Raises UsageError if it is on a server."""
    if is_url(place):
        raise UsageError(
            f"{parse_url(place).redacted}: a local path is needed here; `sonarrec help remote` "
            "says which commands take URLs"
        )
    return place


def parse_url(text: object) -> Url:
    """The URL in a text. Raises UsageError if its scheme is not supported, or if it has a login
    where its scheme has none."""
    match = _URL.match(str(text))
    scheme = match[1].lower() if match else ""
    if match is None or scheme not in SCHEMES:
        known = ", ".join(f"{s}://" for s in SCHEMES)
        raise UsageError(f"{scheme}://: only {known} and local files can be read")
    rest = str(text)[match.end() :]
    host, slash, path = rest.partition("/")
    if scheme in ("s3", "gs"):
        if "@" in host:
            raise UsageError(
                f"{scheme}://{HIDDEN}@{host.rpartition('@')[2]}: {scheme}:// takes no keys in the "
                "URL; `sonarrec help remote` says where credentials are searched"
            )
        return Url(scheme, f"{scheme}://", rest)
    if scheme == "sftp":
        return Url(scheme, f"sftp://{host}", slash + path)
    path, mark, query = path.partition("#")[0].partition("?")
    return Url(scheme, f"{scheme}://{host}", quote(slash + path, f"{_SAFE}%*[]"), mark + query)
