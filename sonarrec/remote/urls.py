"""URLs of logs and results: parsed, built, and written without their secrets."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import TypeVar
from urllib.parse import quote, unquote, urlsplit

from sonarrec.errors import UsageError, name_as_text

Place = TypeVar("Place")
SCHEMES = ("s3", "gs", "https", "http", "sftp")
HIDDEN = "***"
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/{1,2}(?=[^/])")  # a Path keeps one slash only
_SECRET = re.compile(r"(?i)sig|token|secret|key|pass|pwd|cred|auth|jwt|policy|code")
# Quoted slashes and pluses stay quoted: a slash would separate folders, and a plus means a space to
# some servers. %252F is the text %2F, and so on.
_KEPT = re.compile(r"(?i)(%(?:25)*2[BF])")
_LEAST = 4  # characters; shorter secrets are not searched for in error texts


@dataclass(frozen=True, slots=True)
class Url:
    """A place on a server.

    front: "s3://" or "https://user:password@host". path: "bucket/dives/a.mcap" or "/dives/a.mcap",
    unquoted except for %2F and %2B of a web URL. query: of https, with its question mark.
    literal: * ? [ in the path are part of names, not wildcards.
    """

    scheme: str
    front: str
    path: str
    query: str = ""
    literal: bool = field(default=False, compare=False)

    def __str__(self) -> str:
        """The URL with its secrets: for servers only, never for messages or files."""
        path = _changed(self.path, _quoted) if self.is_web else self.path
        return f"{self.front}{path}{self.query}"

    @property
    def is_web(self) -> bool:
        return self.scheme in ("http", "https")

    @property
    def name(self) -> str:
        """The last part of the path; for the root the host name."""
        return PurePosixPath(self.path).name or urlsplit(self.front).hostname or "log"

    @property
    def parent(self) -> Url:
        return replace(self, path=self.path.rstrip("/").rpartition("/")[0])

    def child(self, relative: str) -> Url:
        """The URL of a path below, with the same query, which may hold a key."""
        path = f"{self.path.rstrip('/')}/{relative}"
        return replace(self, path=path.lstrip("/") if self.scheme in ("s3", "gs") else path)

    @property
    def redacted(self) -> str:
        """The URL for messages and files: the password and keys in the query are hidden."""
        scheme, _, rest = self.front.partition("://")
        user, at, host = rest.rpartition("@")
        if at:
            name, colon, _ = user.partition(":")
            # A web user without a password is a token.
            user = f"{name}:{HIDDEN}" if colon else HIDDEN if self.is_web else name
        query = "&".join(_redacted_pair(pair) for pair in self.query.removeprefix("?").split("&"))
        return name_as_text(
            f"{scheme}://{user}{at}{host}{self._readable()}{'?' * bool(query)}{query}"
        )

    def _readable(self) -> str:
        """The path; for a web URL, with characters of special meaning quoted."""
        if not self.is_web:
            return self.path
        marks = "%#?*[" if self.literal else "%#?"
        return _changed(
            self.path, lambda text: "".join(quote(c, safe="") if c in marks else c for c in text)
        )

    @property
    def place(self) -> str:
        """`redacted` without a query."""
        return replace(self, query="").redacted

    def hide(self, text: str) -> str:
        """A text such as an error message without this URL's secrets."""
        text = text.replace(str(self), self.redacted)
        for secret in sorted(self._secrets(), key=len, reverse=True):
            text = text.replace(secret, HIDDEN)
        return text

    def _secrets(self) -> set[str]:
        user, _, _ = self.front.partition("://")[2].rpartition("@")
        name, _, password = user.partition(":")
        secrets = {password} if password or not self.is_web else {name}
        for pair in self.query.removeprefix("?").split("&"):
            key, _, value = pair.partition("=")
            if _SECRET.search(key):
                secrets.add(value)
        secrets |= {unquote(secret) for secret in secrets}
        return {secret for secret in secrets if len(secret) >= _LEAST}


def _quoted(text: str) -> str:
    return quote(text, safe="/*[]!~@:+,;=&$'()")


def _changed(path: str, change: Callable[[str], str]) -> str:
    """A path of a web URL, changed except for its quoted slashes and pluses."""
    parts = _KEPT.split(path)
    return "".join(part if n % 2 else change(part) for n, part in enumerate(parts))


def unquoted(path: str) -> str:
    """The path of a web URL as `Url` holds it."""
    return _changed(path, unquote)


def _redacted_pair(pair: str) -> str:
    key, equals, _ = pair.partition("=")
    return f"{key}={HIDDEN}" if equals and _SECRET.search(key) else pair


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
    """The URL in a text. Raises UsageError if its scheme is not supported."""
    match = _URL.match(str(text))
    scheme = match[1].lower() if match else ""
    if match is None or scheme not in SCHEMES:
        known = ", ".join(f"{s}://" for s in SCHEMES)
        raise UsageError(f"{scheme}://: only {known} and local files can be read")
    rest = str(text)[match.end() :]
    if scheme in ("s3", "gs"):
        return Url(scheme, f"{scheme}://", rest)
    host, slash, path = rest.partition("/")
    if scheme == "sftp":
        return Url(scheme, f"sftp://{host}", slash + path)
    path, mark, query = path.partition("#")[0].partition("?")
    literal = not any(c in path for c in "*[")
    return Url(scheme, f"{scheme}://{host}", unquoted(slash + path), mark + query, literal)
