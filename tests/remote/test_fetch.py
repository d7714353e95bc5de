"""Logs of a real web server, in all its moods, into the cache and out of it."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.remote.cache import Cache, size_bytes
from sonarrec.remote.fetch import fetched
from sonarrec.remote.find import RemoteLog, find
from sonarrec.remote.urls import parse_url
from tests.support.logs import SONAR_TOML
from tests.support.servers import web_server


def noise(path: Path, size: int = 50_000, seed: int = 0) -> bytes:
    data = np.random.default_rng(seed).bytes(size)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return data


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "site").mkdir()
    return tmp_path / "site"


def test_a_log_and_what_lies_beside_it_is_fetched_once(site: Path, cache: Cache) -> None:
    data = noise(site / "day 1" / "a.mcap")
    for name in ("a.sonar.toml", "sonar.toml", "gt.csv", "a.poses.csv", "other.csv"):
        (site / "day 1" / name).write_text(name)
    with web_server(site) as web:
        for _ in range(2):
            with fetched(f"{web.url}/day 1/a.mcap", cache) as log:
                assert log.path.read_bytes() == data
                there = {
                    p.name: p.read_text() for p in log.path.parent.glob("*.*") if p != log.path
                }
                assert there == {
                    n: n for n in ("a.sonar.toml", "sonar.toml", "gt.csv", "a.poses.csv")
                }
                assert log.origin.url == f"{web.url}/day%201/a.mcap"
                told = log.origin.with_server_names(f"{log.path}: bad")
                assert told == f"{log.origin.url}: bad"
        assert len(web.gets("a.mcap")) == 1


def test_a_changed_log_is_fetched_anew(site: Path, cache: Cache) -> None:
    noise(site / "a.mcap")
    with web_server(site) as web:
        with fetched(f"{web.url}/a.mcap", cache):
            pass
        data = noise(site / "a.mcap", seed=1)
        with fetched(f"{web.url}/a.mcap", cache) as log:
            assert log.path.read_bytes() == data


def test_a_transfer_that_breaks_off_is_tried_again(site: Path, cache: Cache) -> None:
    data = noise(site / "a.mcap")
    with web_server(site, broken=3) as web:
        with fetched(f"{web.url}/a.mcap", cache) as log:
            assert log.path.read_bytes() == data
        assert len(web.gets("a.mcap")) == 4


def test_a_log_that_changes_while_it_is_fetched_is_told(site: Path, cache: Cache) -> None:
    noise(site / "a.mcap")

    def change(*_: object) -> None:
        noise(site / "a.mcap", seed=1)

    told = pytest.raises(SonarrecError, match="changed while it was fetched")
    with web_server(site) as web, told, fetched(f"{web.url}/a.mcap", cache, change):
        pass
    assert not list(cache.folder.rglob("*.mcap*"))


def test_what_is_not_there_and_who_does_not_answer_is_told(cache: Cache, site: Path) -> None:
    with web_server(site) as web:
        with (
            pytest.raises(SonarrecError, match=r"none\.mcap: does not exist"),
            fetched(f"{web.url}/none.mcap", cache),
        ):
            pass
        port = web.port
    with (
        pytest.raises(SonarrecError, match=r"^http://u:\*\*\*@.*3 retries") as told,
        fetched(f"http://u:hidden-word@127.0.0.1:{port}/a.mcap", cache),
    ):
        pass
    assert "hidden-word" not in str(told.value)


def test_no_secret_is_written_down(site: Path, cache: Cache) -> None:
    noise(site / "a.mcap")
    with web_server(site) as web:
        url = f"{web.url}/a.mcap?token=hidden-word".replace("//", "//ann:hidden-pass@")
        with fetched(url, cache) as log:
            assert "hidden" not in f"{log}"
        assert "token=hidden-word" in web.asked[0][1]
    assert list(cache.folder.rglob("a.mcap"))
    for path in cache.folder.rglob("*"):
        assert "hidden" not in str(path)
        assert not path.is_file() or b"hidden" not in path.read_bytes()


def test_folders_and_globs_expand(site: Path) -> None:
    for name in ("dives/b10.mcap", "dives/b9.mcap", "dives/deep/c.mcap", "dives/notes.txt"):
        noise(site / name, 10)
    for k in range(3):
        noise(site / f"pings/{k}.png", 10)
    with web_server(site) as web:

        def names(url: str, recursive: bool = False) -> list[str]:
            logs = find(f"{web.url}/{url}", recursive=recursive)
            return [log.url.redacted.removeprefix(f"{web.url}/") for log in logs]

        assert names("dives/") == ["dives/b9.mcap", "dives/b10.mcap"]
        assert names("dives/*.mcap") == ["dives/b9.mcap", "dives/b10.mcap"]
        assert names("dives/b1*.mcap") == ["dives/b10.mcap"]
        assert names("pings/") == ["pings/"]
        assert names("pings/*.png") == ["pings/*.png"]
        assert names("dives/b9.mcap") == ["dives/b9.mcap"]
        assert names("none/") == ["none/"]
        assert names("dives/", recursive=True) == [
            "dives/b9.mcap", "dives/b10.mcap", "dives/deep/c.mcap",
        ]  # fmt: skip
        noise(site / "dives/deep/map.csv", 10)
        assert names("dives/", recursive=True) == ["dives/b9.mcap", "dives/b10.mcap"]


@pytest.mark.parametrize("name", ["a [1]", "a*b", "a?b", "a%20b", "a#b", "ä;b&c=d", "a'b"])
def test_a_name_leads_back_to_its_file(name: str, site: Path, cache: Cache) -> None:
    """What is told, and what run.toml has, is a URL of that very file."""
    data = noise(site / "dives" / f"{name}.mcap", 10)
    noise(site / "dives" / "b.mcap", 20)
    with web_server(site) as web:
        quoted = quote(f"dives/{name}.mcap")
        listed = next(log for log in find(f"{web.url}/dives/") if log.name == name)
        for log in (listed, *find(f"{web.url}/{quoted}")):
            with fetched(log, cache) as found:
                assert found.path.read_bytes() == data
            with fetched(found.origin.url, cache) as found:
                assert found.path.read_bytes() == data


def test_images_are_fetched_as_a_folder_or_by_a_glob(site: Path, cache: Cache) -> None:
    for k in range(12):
        noise(site / f"pings/{k}.png", 10)
    (site / "pings/sonar.toml").write_text(SONAR_TOML)
    (site / "pings/notes.txt").write_text("no")
    with web_server(site) as web:
        with fetched(f"{web.url}/pings", cache) as log:
            assert log.path.name == "pings"
            assert len(list(log.path.iterdir())) == 13
        with fetched(f"{web.url}/pings/1*.png", cache) as log:
            found = sorted(p.name for p in log.path.parent.glob(log.path.name))
            assert found == ["1.png", "10.png", "11.png"]
            assert (log.path.parent / "sonar.toml").exists()


def test_what_serves_a_campaign_is_found_above(site: Path, cache: Cache) -> None:
    noise(site / "campaign/day1/a.mcap", 10)
    (site / "campaign/sonar.toml").write_text("x")
    with web_server(site) as web:
        up_to = parse_url(f"{web.url}/campaign")
        with fetched(RemoteLog(up_to.child("day1/a.mcap"), up_to), cache) as log:
            assert log.up_to is not None
            assert (log.up_to / "sonar.toml").exists()
            assert log.path == log.up_to / "day1" / "a.mcap"


# The cache


def test_the_least_recently_used_goes_and_one_in_use_never(site: Path, tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache", 120_000)
    for n in range(4):
        noise(site / f"{n}.mcap", seed=n)
    with web_server(site) as web:

        def log(n: int) -> str:
            return f"{web.url}/{n}.mcap"

        for n in (0, 1, 0):
            with fetched(log(n), cache):
                time.sleep(0.02)
        with fetched(log(2), cache):  # 1 goes: 0 was used later
            time.sleep(0.02)
        assert [len(web.gets(f"{n}.mcap")) for n in range(3)] == [1, 1, 1]
        with fetched(log(0), cache) as held:  # older than 2 by now, but in use
            with fetched(log(3), cache):
                assert held.path.exists()
            assert len(web.gets("0.mcap")) == 1
        held_bytes = sum(p.stat().st_size for p in cache.folder.rglob("*.mcap"))
        assert held_bytes == 100_000


@pytest.mark.parametrize("lengths", [True, False])
def test_a_log_beyond_the_bound_is_told(lengths: bool, site: Path, tmp_path: Path) -> None:
    """Before it is fetched if the server states its length, else as soon as it is too long."""
    noise(site / "a.mcap", 90_000)
    cache = Cache(tmp_path / "cache", 40_000)
    with (
        web_server(site, lengths=lengths) as web,
        pytest.raises(SonarrecError, match=r"is more than the cache may hold \(40 kB\)"),
        fetched(f"{web.url}/a.mcap", cache),
    ):
        pass
    assert sum(p.stat().st_size for p in cache.folder.rglob("*.part")) <= 60_000
    assert bool(web.gets("a.mcap")) is not lengths


def test_one_without_a_length_makes_room_and_goes_after_use(site: Path, tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache", 100_000)
    for n in range(2):
        noise(site / f"{n}.mcap", 70_000, seed=n)
    with web_server(site) as web, fetched(f"{web.url}/0.mcap", cache) as held:
        web.lengths = False
        told = pytest.raises(SonarrecError, match="do not fit beside the logs in use")
        with told, fetched(f"{web.url}/1.mcap", cache):
            pass
        assert held.path.exists()
    with web_server(site, lengths=False) as web, fetched(f"{web.url}/1.mcap", cache) as found:
        assert found.path.read_bytes() == (site / "1.mcap").read_bytes()
        assert not held.path.exists()
    assert not found.path.exists()


def test_two_at_once_fetch_it_once(site: Path, cache: Cache) -> None:
    data = noise(site / "a.mcap")
    with web_server(site) as web:
        seen = []

        def one() -> None:
            with fetched(f"{web.url}/a.mcap", cache) as log:
                seen.append(log.path.read_bytes() == data)

        threads = [threading.Thread(target=one) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert seen == [True] * 3
        assert len(web.gets("a.mcap")) == 1


def test_a_cache_that_cannot_be_written_is_told(site: Path, tmp_path: Path) -> None:
    noise(site / "a.mcap")
    (tmp_path / "file").write_text("no folder")
    with (
        web_server(site) as web,
        pytest.raises(SonarrecError, match="choose another --cache"),
        fetched(f"{web.url}/a.mcap", Cache(tmp_path / "file" / "cache", 10**7)),
    ):
        pass


def test_sizes() -> None:
    told = {"500MB": 5 * 10**8, "1.5 TB": 15 * 10**11, "20g": 2 * 10**10, "7": 7}
    assert {text: size_bytes(text) for text in told} == told
    for text in ("", "many", "-1GB", "1XB"):
        with pytest.raises(SonarrecError, match="--cache-size"):
            size_bytes(text)
