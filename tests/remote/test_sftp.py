"""Logs and results of a real SFTP server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.remote.cache import Cache
from sonarrec.remote.fetch import fetched, fetched_results
from sonarrec.remote.find import beside, find
from sonarrec.remote.upload import Outbox
from sonarrec.remote.urls import parse_url
from tests.support.servers import sftp_server

PASSWORD = "hidden-word"


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    """The server's disk."""
    for name in ("dives/a.mcap", "dives/b.mcap", "dives/sonar.toml"):
        path = tmp_path / "disk" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode() * 9000)
    return tmp_path / "disk"


@pytest.fixture
def url(disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    with sftp_server(disk, tmp_path / "home", PASSWORD) as port:
        yield f"sftp://ann:{PASSWORD}@127.0.0.1:{port}"


def test_logs_come_with_what_lies_beside_them(url: str, disk: Path, cache: Cache) -> None:
    logs = find(f"{url}/dives/*.mcap")
    assert [log.url.name for log in logs] == ["a.mcap", "b.mcap"]
    assert [log.url.name for log in find(f"{url}/dives")] == ["a.mcap", "b.mcap"]
    for log in logs:
        with fetched(log, cache) as here:
            assert here.path.read_bytes() == (disk / "dives" / log.url.name).read_bytes()
            assert here.path.with_name("sonar.toml").exists()
            assert PASSWORD not in here.origin.url


def test_truth_is_found_beside_a_log(url: str, disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert beside(f"{url}/dives/a.mcap", "gt.csv") == (None, 9000 * len("dives/a.mcap"))
    for name in ("dives/gt.csv", "dives/b.gt.csv", "dives.gt.csv"):
        (disk / name).write_text("frame,landmark\n")
    for log, truth in (("a.mcap", "gt.csv"), ("b.mcap", "b.gt.csv")):
        item, _ = beside(f"{url}/dives/{log}", "gt.csv")
        assert item is not None
        assert item.url.name == truth
    with pytest.raises(SonarrecError, match="does not exist"):
        beside(f"{url}/dives/none.mcap", "gt.csv")
    # As run.toml has it, without the password: this is told, and not tried.
    with pytest.raises(SonarrecError, match="toml does not keep the secret"):
        beside(parse_url(f"{url}/dives/a.mcap").redacted, "gt.csv")
    monkeypatch.setitem(fsspec.config.conf, "sftp", {"password": PASSWORD})
    item, _ = beside(f"{url.replace(f':{PASSWORD}', '')}/dives/a.mcap", "gt.csv")
    assert item is not None


def test_results_go_there_and_come_back(url: str, disk: Path, cache: Cache) -> None:
    box = Outbox(parse_url(f"{url}/out/new"), cache)
    for text in ("first", "second"):
        with box.results("a"):
            for name in ("run.toml", "frames.csv", "estimates.csv"):
                (box.folder / "a").mkdir(parents=True, exist_ok=True)
                (box.folder / "a" / name).write_text(text)
        there = {p.name: p.read_text() for p in (disk / "out" / "new" / "a").iterdir()}
        assert there == dict.fromkeys(("run.toml", "frames.csv", "estimates.csv"), text)
    with fetched_results(f"{url}/out/new", cache) as here:
        assert (here.path / "a" / "frames.csv").read_text() == "second"


def test_a_wrong_password_is_told_without_it(url: str, cache: Cache) -> None:
    wrong = url.replace(PASSWORD, "other-word")
    with pytest.raises(SonarrecError, match="no access") as told, fetched(f"{wrong}/a.mcap", cache):
        pass
    assert "other-word" not in str(told.value)


def test_a_server_whose_key_is_not_known_is_refused(url: str, cache: Cache, tmp_path: Path) -> None:
    (tmp_path / "home" / ".ssh" / "known_hosts").write_text("")
    with (
        pytest.raises(SonarrecError, match=r"no access \(.*key"),
        fetched(f"{url}/dives/a.mcap", cache),
    ):
        pass
