"""`sonarrec run` with logs and results on servers: one that speaks S3, and a plain web server."""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sonarrec.cli import main
from sonarrec.errors import SonarrecError, is_url, redact_urls
from sonarrec.runs import remote
from tests.support.command import sonarrec
from tests.support.logs import cdr_image, frames, mcap_file
from tests.support.rows import read_rows

TABLES = ("estimates.csv", "frames.csv", "sightings.csv")


def small_mcap(path: Path, seed: int = 0) -> Path:
    images = frames(6, seed=seed)
    return mcap_file(path, [("/s", k * 10**8, cdr_image(i)) for k, i in enumerate(images)])


@pytest.fixture
def s3(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A client of another library, with an empty bucket `dives` on a server that speaks S3."""
    import boto3
    from moto.server import ThreadedMotoServer  # by those who need it: to load it takes long

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name in [n for n in os.environ if n.startswith(("AWS_", "FSSPEC_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "made-up")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "made-up-secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    client = boto3.client("s3")
    client.create_bucket(Bucket="dives")
    yield client
    server.stop()


def keys(s3: Any) -> set[str]:
    return {one["Key"] for one in s3.list_objects_v2(Bucket="dives").get("Contents", [])}


@pytest.mark.slow
def test_logs_and_results_on_s3(tmp_path: Path, s3: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its results are those of the local logs; one that is no log costs itself."""
    day = tmp_path / "day"
    for seed, name in enumerate(("a.mcap", "b.mcap")):
        small_mcap(day / name, seed)
    (day / "c.mcap").write_bytes(b"no recording at all")
    for path in day.iterdir():
        s3.upload_file(str(path), "dives", f"day/{path.name}")
    sonarrec("run", day, "-o", tmp_path / "local", code=3)
    far = ("s3://dives/day/", "-o", "s3://dives/results")
    told = sonarrec("run", *far, "--jobs", "1", code=3)
    assert "s3://dives/day/c.mcap" in told.stderr
    assert "sonarrec-" not in told.stderr + told.stdout  # temporary folders
    for name in ("a", "b"):
        for table in TABLES:
            s3.download_file("dives", f"results/{name}/{table}", str(tmp_path / "there"))
            local = tmp_path / "local" / name / table
            assert (tmp_path / "there").read_bytes() == local.read_bytes()
    s3.download_file("dives", "results/a/run.toml", str(tmp_path / "run.toml"))
    assert 'path = "s3://dives/day/a.mcap"' in (tmp_path / "run.toml").read_text()
    s3.download_file("dives", "results/logs.csv", str(tmp_path / "logs.csv"))
    status = {row["log"]: row["status"] for row in read_rows(tmp_path / "logs.csv")}
    assert status == {"a": "done", "b": "done", "c": "failed"}
    before = keys(s3)
    assert not {key for key in before if ".part" in key or key.startswith("results/c/")}
    # Again: what is there is up to date. Stopped in the middle of a transfer: it stays as it was.
    assert "up to date" in sonarrec("run", *far, "--jobs", "1", code=3).output
    assert keys(s3) == before

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    fs = type(remote._opened("s3://dives/results")[0])
    monkeypatch.setattr(fs, "find", stopped)
    with pytest.raises(KeyboardInterrupt):
        remote.upload(tmp_path / "local" / "a", "s3://dives/results/a")
    assert keys(s3) == before


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """stderr is the command's here."""


def test_logs_on_a_web_server_without_a_secret_told(tmp_path: Path) -> None:
    small_mcap(tmp_path / "day" / "a.mcap")
    handler = partial(Quiet, directory=str(tmp_path))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        host = f"127.0.0.1:{server.server_address[1]}"
        out = tmp_path / "out"
        told = sonarrec("run", f"http://ann:s3cret@{host}/day/a.mcap?key=s3cret", "-o", out)
        sonarrec("run", tmp_path / "day" / "a.mcap", "-o", tmp_path / "local")
        for table in TABLES:
            local = tmp_path / "local" / "a" / table
            assert (out / "a" / table).read_bytes() == local.read_bytes()
        run = (out / "a" / "run.toml").read_text(encoding="utf-8")
        assert f"http://{host}/day/a.mcap" in run
        assert "s3cret" not in run + (out / "logs.csv").read_text() + told.stdout + told.stderr
        by_index = sonarrec("run", f"http://{host}/day/", "-o", tmp_path / "index")
        assert "index/a: 6 frames" in by_index.stdout
        gone = sonarrec("run", f"http://u:s3cret@{host}/day/b.mcap?k=s3cret", code=2).stderr
        assert f"http://{host}/day/b.mcap" in gone
        assert "s3cret" not in gone
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("sftp://ann:pw@boat:22/logs/a.mcap", "sftp://boat:22/logs/a.mcap"),
        ("https://h/a.mcap?X-Amz-Signature=1#x", "https://h/a.mcap"),
        ("https://h/a;k=1", "https://h/a"),
        ("no 's3://key:pw@b/k' here", "no 's3://b/k' here"),
        ("dives/a.mcap?", "dives/a.mcap?"),
        ("https://h/a.mcap#token=t0ken", "https://h/a.mcap"),
        ("https://u:it's@h/x: not there", "https://h/x: not there"),
        ("https://u:a b@h/x and s3://k:p/w+=@b/y", "https://h/x and s3://b/y"),
        ("'https://h/x?sig=a/b:c': no such file", "'https://h/x': no such file"),
    ],
)
def test_no_output_has_a_secret(text: str, shown: str) -> None:
    assert redact_urls(text) == shown


@pytest.mark.parametrize(
    "words",
    [
        *("run", "info", "evaluate", "report", "overlay", "map", "calibrate", "check", "help"),
        *("landmarks", "truth check x", "truth convert", "truth propose", "run x --preset"),
        *("run x --landmarks", "run x --set", "run x --config", "evaluate --ground-truth"),
    ],
)
def test_no_message_has_a_secret(words: str) -> None:
    url = "https://me:s3cret@host.invalid/a;k=s3cret?X-Amz-Signature=s3cret"
    done = sonarrec(*words.split(), url, code=2)
    assert "s3cret" not in done.output


def test_what_takes_no_url_says_so() -> None:
    told = sonarrec("evaluate", "s3://user:pw@bucket/results", code=2).stderr
    assert told.startswith("sonarrec: s3://bucket/results: ")
    assert is_url(Path("s3://bucket/a"))
    assert not is_url("a:b/c")
    with pytest.raises(SonarrecError, match="only s3://"):
        remote.logs_at("ftp://host/a/")
    sonarrec("run", "a.mcap", "-o", "https://host/out", code=2)


SECRETS = ("s3cret", "s3'cret", "s3 cret", "s3/cret", "s3@cret", "s3%2Fcret", "s3cret/+=s3cret")
URLS = (
    "http://me:{}@127.0.0.1:1/a.mcap",
    "https://127.0.0.1:1/a.mcap#token={}",
    "https://127.0.0.1:1/a.mcap?X-Amz-Signature={}",
    "s3://me:{}@bucket/a.mcap",
    "gs://me:{}@bucket/a.mcap",
    "sftp://me:{}@127.0.0.1:1/a.mcap",
    "ftp://me:{}@127.0.0.1:1/a.mcap",
)


@pytest.mark.parametrize(
    ("url", "secret"), [(URLS[0], s) for s in SECRETS] + [(url, SECRETS[1]) for url in URLS[1:]]
)
def test_no_library_and_no_option_tells_a_secret(url: str, secret: str, tmp_path: Path) -> None:
    full, out = url.format(secret), tmp_path / "out"
    words = ("run", full, "-o", out), ("run", "--from-file", full), ("info", full)
    for line in (*words, ("run", "x", "--seed", full), ("landmarks", full, full), (full,)):
        done = CliRunner().invoke(main, [str(word) for word in line])
        assert done.exit_code in (1, 2)
        assert not re.search("s3|cret", done.output.replace("s3://", "")), done.output


def test_a_server_that_does_not_answer_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(*_: object) -> None:
        raise AssertionError("it still waits")

    signal.signal(signal.SIGALRM, late)
    monkeypatch.setattr(remote, "TIMEOUT_S", 1)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "made-up")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "made-up")
    with socket.create_server(("127.0.0.1", 0)) as server:
        host = f"127.0.0.1:{server.getsockname()[1]}"
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}")
        for url in (f"http://{host}/a.mcap", "s3://bucket/a.mcap"):
            signal.alarm(60)  # its handler fails the test: not after minutes
            told = sonarrec("run", url, "-o", tmp_path / "out", code=1).stderr
            signal.alarm(0)
            assert len(told.splitlines()) == 1
