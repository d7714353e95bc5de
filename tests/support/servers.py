"""Real servers on loopback, started by a test: HTTP in several moods, and SFTP."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


@dataclass
class Web:
    """A web server over a folder, and how it behaves.

    lengths: it tells how long files are. broken: how many more answers break off in the middle.
    asked: (method, path, Range or "") of every request.
    """

    folder: Path
    lengths: bool = True
    tags: bool = True
    broken: int = 0
    port: int = 0
    asked: list[tuple[str, str, str]] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def gets(self, name: str) -> list[str]:
        """The Range of every GET of a file."""
        return [r for method, path, r in self.asked if method == "GET" and path.endswith(name)]


@contextmanager
def web_server(folder: Path, **how: Any) -> Iterator[Web]:
    """A web server over a folder; how: fields of Web."""
    web = Web(folder, **how)

    class Handler(SimpleHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: object) -> None:
            pass

        def translate_path(self, path: str) -> str:
            return super().translate_path(path.partition("?")[0])

        def do_HEAD(self) -> None:
            self.answer(body=False)

        def do_GET(self) -> None:
            self.answer(body=True)

        def answer(self, body: bool) -> None:
            web.asked.append((self.command, self.path, self.headers.get("Range", "")))
            path = Path(self.translate_path(self.path))
            if path.is_dir():
                if body:
                    super().do_GET()
                else:
                    super().do_HEAD()
                return
            if not path.is_file():
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            data = path.read_bytes()
            whole = len(data)
            asked = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
            if asked:
                start = int(asked[1])
                data = data[start : int(asked[2]) + 1 if asked[2] else None]
                self.send_response(HTTPStatus.PARTIAL_CONTENT)
                self.send_header("Content-Range", f"bytes {start}-{start + len(data) - 1}/{whole}")
            else:
                self.send_response(HTTPStatus.OK)
            if web.tags:
                self.send_header("ETag", f'"{path.stat().st_mtime_ns}-{whole}"')
            if web.lengths:
                self.send_header("Content-Length", str(len(data)))
            self.send_header("Connection", "close")
            self.end_headers()
            if not body:
                return
            if web.broken and len(data) > 1000:
                web.broken -= 1
                data = data[: len(data) // 2]
            self.wfile.write(data)
            self.close_connection = True

    handler: Any = Handler
    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), lambda *given: handler(*given, directory=str(folder))
    )
    web.port = server.server_address[1]
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield web
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def sftp_server(folder: Path, home: Path, password: str) -> Iterator[int]:
    """A real SFTP server over a folder, for user `ann`; its key is in home/.ssh/known_hosts.

    Gives its port. asyncssh is on both sides, for sshfs rests on it.
    """
    import asyncssh  # by those who need it: to load it takes long

    key = asyncssh.generate_private_key("ssh-ed25519")
    loop = asyncio.new_event_loop()

    class Login(asyncssh.SSHServer):
        def begin_auth(self, _: str) -> bool:
            return True

        def password_auth_supported(self) -> bool:
            return True

        def validate_password(self, username: str, given: str) -> bool:
            return (username, given) == ("ann", password)

    def served(channel: Any) -> asyncssh.SFTPServer:
        return asyncssh.SFTPServer(channel, chroot=str(folder).encode())

    listening = asyncssh.listen(
        "127.0.0.1", 0, server_host_keys=[key], server_factory=Login, sftp_factory=served
    )
    server = loop.run_until_complete(listening)
    port = server.get_port()
    (home / ".ssh").mkdir(parents=True)
    public = key.export_public_key().decode()
    (home / ".ssh" / "known_hosts").write_text(f"[127.0.0.1]:{port} {public}")
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        yield port
    finally:
        loop.call_soon_threadsafe(server.close)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
