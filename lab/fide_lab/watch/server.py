"""Serves the page of one run directory, to this machine only.

The header Host must name 127.0.0.1 or localhost: a page of the web may give us another name.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files as resources
from pathlib import Path
from typing import Any

from fide_lab.watch.snapshot import PICTURES, RunFiles
from fide_plugins.errors import OptionError

_PAGE = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_PATIENCE = 10.0  # seconds for a request to arrive
_POLL = 0.05  # seconds after which `close` is noticed


class Server(ThreadingHTTPServer):
    """The page of one run directory on 127.0.0.1.

    port: 0 for any that is free.
    """

    daemon_threads = True

    def __init__(self, directory: str | os.PathLike[str], port: int = 0) -> None:
        self.run = RunFiles(directory)
        super().__init__(("127.0.0.1", port), _Handler)
        self.hosts = {f"{name}:{self.server_port}" for name in ("127.0.0.1", "localhost")}
        if self.server_port == 80:
            self.hosts |= {"127.0.0.1", "localhost"}

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that leaves before its answer is no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)

    def close(self) -> None:
        """End it, and free the port."""
        self.shutdown()
        self.server_close()


def serve(directory: str | os.PathLike[str], port: int = 0) -> tuple[Server, str]:
    """Serve a run directory in a background thread; returns the server and its address.

    directory: need not be there yet.  port: 0 for any that is free.
    The thread ends with the process, or with `server.close()`.

    Raises OptionError (a ValueError) for what is a file or no port, OSError if the port is in use.
    """
    path = Path(directory)
    if path.exists() and not path.is_dir():
        raise OptionError(f"{os.fspath(directory)!r} is no directory; name that of a run")
    if not 0 <= port <= 65535:
        raise OptionError(f"a port is a number from 0 to 65535, not {port}")
    server = Server(directory, port)
    serving = partial(server.serve_forever, poll_interval=_POLL)
    threading.Thread(target=serving, name="fide-watch", daemon=True).start()
    return server, server.url


class _Handler(BaseHTTPRequestHandler):
    """Answers GET of known names; all other methods are refused by the base class (501)."""

    server: Server
    timeout = _PATIENCE
    server_version, sys_version = "fide", ""

    def do_GET(self) -> None:  # the base class's name
        if self.headers.get_all("Host", []) not in ([host] for host in self.server.hosts):
            self._answer(HTTPStatus.MISDIRECTED_REQUEST, "text/plain", b"this is 127.0.0.1\n")
            return
        path = self.path.partition("?")[0]
        found = self._found(path)
        if found is None:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"not found\n")
        else:
            self._answer(HTTPStatus.OK, *found)

    def _found(self, path: str) -> tuple[str, bytes] | None:
        if path in _PAGE:
            name, kind = _PAGE[path]
            return kind, (resources("fide_lab.watch") / "page" / name).read_bytes()
        if path == "/state.json":
            return "application/json", json.dumps(self.server.run.state()).encode()
        if path[1:] in PICTURES and path[0] == "/":
            data = self.server.run.picture(path[1:])
            return None if data is None else ("image/png", data)
        return None

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: the terminal belongs to the fit."""
