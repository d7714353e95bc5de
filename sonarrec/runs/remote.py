"""Logs on servers, by fsspec: a log is fetched whole, run as a local one, its results are put."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote

from sonarrec.errors import MissingError, SonarrecError, UsageError, is_url, number_of, redact_url
from sonarrec.readers.containers.bag_folder import METADATA
from sonarrec.readers.containers.images import names_an_image
from sonarrec.readers.named_logs import RESULTS
from sonarrec.readers.open import log_name, names_a_log
from sonarrec.runs.job import Job
from sonarrec.tables import natural_order

TIMEOUT_S = 60
"""A server that says nothing for so long gives no answer."""
SCHEMES = ("s3", "gs", "https", "http", "sftp")
COMPANIONS = ("sonar.toml", "landmarks.toml", "poses.csv")
"""Files that may belong to a log: of these names, and NAME.sonar.toml and so on."""


def check_out(url: str) -> None:
    """Raise UsageError if results cannot be put there."""
    if url.partition(":")[0].lower() in ("http", "https"):
        raise UsageError(
            f"{redact_url(url)}: results cannot be put on a web server; give s3, gs, sftp"
        )
    with _in_one_line(url):
        _opened(url)


def logs_at(url: str, *, recursive: bool = False) -> list[str]:
    """The URLs of the logs that a URL names: a log, those of a folder, or those of a glob.

    Raises UsageError for another kind of server, SonarrecError if it cannot be read.
    """
    if names_a_log(_name(url)) and not set(_name(url)) & set("*?["):
        return [url]
    with _in_one_line(url):
        fs, path = _opened(url)
        front = url.rstrip("/").removesuffix(path.rstrip("/"))
        if set(path) & set("*?["):
            paths = [p for p in fs.glob(path) if names_a_log(_name(p))]
        else:
            paths = [*_below(fs, path, recursive)]
    if not paths:
        raise MissingError(f"{redact_url(url)}: no log there")
    return [front + p for p in sorted(paths, key=natural_order)]


def _below(fs: Any, top: str, recursive: bool) -> Iterator[str]:
    """The logs in a folder: the folder itself if it holds images or a bag's parts."""
    for folder, _, names in fs.walk(top, maxdepth=None if recursive else 1):
        if RESULTS.intersection(names):
            continue
        if METADATA in names or any(map(names_an_image, names)):
            yield folder
        else:
            yield from (f"{folder.rstrip('/')}/{n}" for n in names if names_a_log(n))


@contextmanager
def local_copy(job: Job) -> Iterator[Job]:
    """The job with its log and its results in temporary folders, until the block ends.

    The log is fetched; the results begin with those that the server has.
    """
    with ExitStack() as stack:
        if is_url(job.log):
            folder = stack.enter_context(TemporaryDirectory(prefix="sonarrec-"))
            url = redact_url(job.log).rstrip("/").rpartition("/")[0]
            log = _fetched(job.log, Path(folder))
            job = replace(job, log=str(log), urls={folder: url})
        if is_url(job.out):
            folder, url = stack.enter_context(TemporaryDirectory(prefix="sonarrec-")), job.out
            download(f"{url.rstrip('/')}/{job.name}", Path(folder, job.name))
            job = replace(job, out=folder, urls={**job.urls, folder: redact_url(url).rstrip("/")})
        yield job


def _fetched(url: str, folder: Path) -> Path:
    """Fetch a log, and what belongs to it, such as sonar.toml, into a folder."""
    with _in_one_line(url):
        fs, path = _opened(url.rstrip("/"))
        parent, name = path.partition("?")[0].rpartition("/")[0], _name(url)
        log = Path(folder, name)
        fetch = fs.get_file if names_a_log(name) else partial(fs.get, recursive=True)
        fetch(path, str(log))
        own = [f"{log_name(log)}.{companion}" for companion in COMPANIONS]
        for companion in filter(lambda c: fs.exists(f"{parent}/{c}"), (*own, *COMPANIONS)):
            fs.get_file(f"{parent}/{companion}", str(Path(folder, companion)))
    return log


def download(url: str, target: Path) -> None:
    """Fetch a file or folder, if it is there."""
    with _in_one_line(url):
        fs, path = _opened(url)
        if fs.exists(path):
            fs.get(path, str(target), recursive=True)


def upload(source: Path, url: str) -> None:
    """Replace a file or folder on a server; what is there stays until the new one is complete."""
    with _in_one_line(url):
        fs, path = _opened(url)
        part = f"{path}.part"
        try:
            fs.put(str(source), part, recursive=source.is_dir())
            sent, came = sum(p.is_file() for p in (source, *source.rglob("*"))), fs.find(part)
            if len(came) != sent:
                raise SonarrecError(
                    f"{redact_url(url)}: {len(came)} of {number_of(sent, 'file')} arrived"
                )
            if fs.exists(path):
                fs.rm(path, recursive=True)
            if source.is_dir():
                fs.makedirs(path, exist_ok=True)
            for file in sorted(came, key=lambda name: name.endswith("run.toml")):  # that last
                fs.mv(file, path + file[len(part) :])
            with suppress(FileNotFoundError):  # where folders exist by themselves
                fs.rm(part, recursive=True)
        except BaseException:  # Ctrl-C as well
            with suppress(Exception):
                fs.rm(part, recursive=True)
            raise


def _name(url: str) -> str:
    end = "[?#]" if url.lower().startswith("http") else "[?]"  # elsewhere # is a sign of a name
    return re.split(end, url)[0].rstrip("/").rpartition("/")[2]


def _opened(url: str) -> tuple[Any, str]:
    """(the file system of a URL, the path in it)."""
    scheme = url.partition(":")[0].lower()
    if scheme not in SCHEMES:
        raise UsageError(f"{scheme}://: only {'://, '.join(SCHEMES)}:// and local files are read")
    before = re.split("[?;#]", url)[0]
    if scheme in ("s3", "gs") and redact_url(before) != before:
        raise UsageError(
            f"{redact_url(url)}: a key in a URL of {scheme}:// is not used; leave it out, "
            "`sonarrec help run` has where keys are searched"
        )
    try:
        import fsspec

        if scheme == "sftp":  # sshfs would take any host key; () stands for the user's known_hosts
            from sshfs import SSHFileSystem

            stated = fsspec.config.conf.get("sftp", {}) | {
                "known_hosts": (),
                "connect_timeout": TIMEOUT_S / 2,
                "login_timeout": TIMEOUT_S / 2,
            }
            options = SSHFileSystem._get_kwargs_from_urls(url) | stated
            return SSHFileSystem(**options), SSHFileSystem._strip_protocol(url)
        fs, path = fsspec.url_to_fs(url, use_listings_cache=False, **_patience(scheme))
    except ImportError as error:
        missing = f"{error.name} is missing; pip install 'sonarrec[remote]'"
        raise SonarrecError(f"{redact_url(url)}: {missing}") from None
    return fs, path


def _patience(scheme: str) -> dict[str, Any]:
    """The options by which a library gives up after TIMEOUT_S without an answer."""
    if scheme == "s3":  # s3fs tries five times, botocore as often within each
        each = {"connect_timeout": TIMEOUT_S / 6, "read_timeout": TIMEOUT_S / 6}
        return {"config_kwargs": {**each, "retries": {"max_attempts": 0}}}
    if scheme == "gs":
        return {"requests_timeout": TIMEOUT_S}
    import aiohttp

    silent = aiohttp.ClientTimeout(total=None, sock_connect=TIMEOUT_S, sock_read=TIMEOUT_S)
    return {"client_kwargs": {"timeout": silent}}


@contextmanager
def _in_one_line(url: str) -> Iterator[None]:
    """Errors of the libraries become one line without secrets."""
    try:
        yield
    except SonarrecError:
        raise
    except FileNotFoundError:
        raise MissingError(f"{redact_url(url)}: not there, or no answer from its server") from None
    except Exception as error:  # s3fs, gcsfs, aiohttp and asyncssh have no common class
        text = " ".join(str(error).replace(url, redact_url(url)).split())[:200]
        signs = r"[\s:@/?;#&=]+"
        secrets = {*re.split(signs, url), *re.split(signs, unquote(url))}
        secrets -= {*re.split(signs, redact_url(url))}
        if not text or any(len(secret) > 1 and secret in text for secret in secrets):
            text = type(error).__name__
        raise SonarrecError(f"{redact_url(url)}: {text}; see `sonarrec help run`") from None
