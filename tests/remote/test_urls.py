"""URLs keep their secrets, and lead where they say."""

from __future__ import annotations

import re

import pytest

from sonarrec.errors import UsageError
from sonarrec.remote.urls import is_url, parse_url


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("s3://dives/day 1/a.mcap", "s3://dives/day 1/a.mcap"),
        ("https://ann:s3cret@host:8080/a.mcap", "https://ann:***@host:8080/a.mcap"),
        ("https://t0ken@host/a.mcap", "https://***@host/a.mcap"),
        ("sftp://ann@host/a.mcap", "sftp://ann@host/a.mcap"),
        ("sftp://ann:pw:d@host/a.mcap", "sftp://ann:***@host/a.mcap"),
        (
            "https://h/a.mcap?X-Amz-Signature=abc&versionId=7&sig=d",
            "https://h/a.mcap?X-Amz-Signature=***&versionId=***&sig=***",
        ),
    ],
)
def test_secrets_are_hidden(url: str, shown: str) -> None:
    assert parse_url(url).redacted == shown
    assert str(parse_url(url)).replace("%20", " ") == url


@pytest.mark.parametrize("key", ["access", "k", "hmac", "st", "X-Amz-Signature", "versionId"])
def test_every_value_of_a_query_is_hidden(key: str) -> None:
    url = parse_url(f"https://h/a.mcap?x=1&{key}=abcdef&bare")
    assert url.redacted == f"https://h/a.mcap?x=***&{key}=***&***"
    for text in (f"GET {url}", "no abcdef", "at https://h/a.mcap?x=1&bare", "https://ab:c@h/"):
        assert not {"abcdef", "bare", "x=1", "ab:c"} & set(re.split(r"[ /?&@]", url.hide(text)))


@pytest.mark.parametrize("scheme", ["s3", "gs"])
def test_keys_in_front_of_a_bucket_are_refused_and_hidden(scheme: str) -> None:
    with pytest.raises(UsageError, match=r"takes no keys in the URL") as told:
        parse_url(f"{scheme}://KEY:SECRET@dives/a.mcap")
    assert str(told.value).startswith(f"{scheme}://***@dives: ")
    assert "KEY" not in str(told.value)
    assert parse_url(f"{scheme}://dives/a@b.mcap").name == "a@b.mcap"


def test_a_librarys_words_are_shown_without_secrets() -> None:
    url = parse_url("https://ann:s%2Fcret@host/a.mcap?token=abcdef")
    for text in (str(url), "403 for s%2Fcret", "403 for s/cret", "no abcdef here"):
        hidden = url.hide(text)
        assert "***" in hidden
        assert not any(secret in hidden for secret in ("s%2Fcret", "s/cret", "abcdef"))


@pytest.mark.parametrize("name", ["dives/a.mcap", "/s3/a.mcap", "C:\\a.mcap", "C:/a.mcap", "a:b"])
def test_local_paths_are_no_urls(name: str) -> None:
    assert not is_url(name)


def test_a_url_that_went_through_a_path_is_one() -> None:
    assert str(parse_url("s3:/dives/a.mcap")) == "s3://dives/a.mcap"


def test_other_schemes_are_refused_with_those_that_are_read() -> None:
    with pytest.raises(UsageError, match=r"ftp://: only s3://, gs://"):
        parse_url("ftp://host/a.mcap")


def test_places_beside_and_below() -> None:
    for text in ("s3://b/x/a.mcap", "https://h/x/a.mcap?token=1", "sftp://h/x/a.mcap"):
        url = parse_url(text)
        assert url.name == "a.mcap"
        assert str(url.parent.child("a.mcap")) == text
        assert str(url.parent.child("sonar.toml")) == text.replace("a.mcap", "sonar.toml")


@pytest.mark.parametrize(
    "path", ["a%2Fb.mcap", "a%2fb+c.mcap", "a%2Bb.mcap", "a%252Fb.mcap", "100%25%2B%20x.mcap"]
)
def test_a_web_server_is_asked_for_what_was_written(path: str) -> None:
    """A quoted slash or plus is neither what parts folders nor what stands for a space."""
    text = f"https://h/o/{path}?alt=media"
    url = parse_url(text)
    assert str(url) == text
    assert str(parse_url(url.place)) == text.partition("?")[0]
    assert str(url.parent) == "https://h/o?alt=media"
    assert str(url.parent.child(url.name)) == text


@pytest.mark.parametrize("front", ["s3://b", "gs://b", "sftp://h"])
def test_names_of_other_servers_are_text(front: str) -> None:
    url = parse_url(f"{front}/x/a+b%2Fc%2Bd.mcap")
    assert (url.name, str(url)) == ("a+b%2Fc%2Bd.mcap", f"{front}/x/a+b%2Fc%2Bd.mcap")
