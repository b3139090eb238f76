"""The page can be neither written to, nor reached by another name, nor made to show other files."""

from __future__ import annotations

import http.client
import json
import os
import socket
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from PIL import ImageFile

from fide_lab.watch import Server, serve
from fide_plugins.errors import OptionError
from fide_plugins.runtime import files

from .conftest import write_curve


def ask(server: Server, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, Any]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=5)
    try:
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers
    finally:
        connection.close()


def test_the_page_and_its_parts(server: Server) -> None:
    for path in ("/", "/page.js", "/page.css", "/state.json", "/target.png", "/best.png?1"):
        status, body, headers = ask(server, path)
        assert status == 200 and body
        assert headers["X-Content-Type-Options"] == "nosniff"
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'") and "unsafe" not in policy
    assert b"://" not in ask(server, "/")[1] + ask(server, "/page.css")[1]


def test_the_state_is_that_of_the_files(server: Server, directory: Path) -> None:
    state = json.loads(ask(server, "/state.json")[1])
    assert (state["state"], state["task"], state["loss"]) == ("running", "scene.py:render", "mse")
    assert (state["evaluations"], state["budget"], state["best_loss"]) == (120, 500, 0.002)
    assert state["improvements"] == [[1, 0.5], [3, 0.1], [120, 0.002]]
    assert state["parameters"] == [["azimuth", "12.5", "deg"], ["floor", "<b>wood</b>", ""]]
    assert state["failures"] == 2
    write_curve(directory, 300, 0.001)
    assert json.loads(ask(server, "/state.json")[1])["evaluations"] == 300
    for name in ("curve.csv", "run.ckpt"):
        (directory / name).unlink()
    state = json.loads(ask(server, "/state.json")[1])
    assert state["improvements"] == state["parameters"] == [] and "evaluations" not in state


def test_totals_of_an_earlier_call_are_not_shown(server: Server, directory: Path) -> None:
    run = json.loads((directory / "run.json").read_text())
    finished = {**run, "totals": {"status": "solved", "sentence": "Solved."}}
    (directory / "run.json").write_text(json.dumps(finished))
    assert "sentence" not in json.loads(ask(server, "/state.json")[1])
    (directory / "run.json").write_text(json.dumps({**finished, "state": "finished"}))
    assert json.loads(ask(server, "/state.json")[1])["sentence"] == "Solved."


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no such locks on Windows")
def test_a_run_whose_process_was_killed_is_not_shown_as_running(
    server: Server, directory: Path
) -> None:
    def shown() -> Any:
        return json.loads(ask(server, "/state.json")[1])

    assert shown()["state"] == "running", "without a lock nothing is known"
    with files.locked(directory / ".run.lock"):
        assert shown()["state"] == "running"
    assert shown()["state"] == "stopped without an end; continue with --resume"


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS", "TRACE"])
def test_nothing_can_be_written(server: Server, directory: Path, method: str) -> None:
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    assert ask(server, "/best.png", method)[0] == 501
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before


@pytest.mark.parametrize(
    "path",
    [
        "/../secret.png",
        "/%2e%2e/secret.png",
        "/..%2fsecret.png",
        "//secret.png",
        "/run.json",
        "/run.ckpt",
        "/target.png/",
        "/./target.png",
        "target.png",
        "http://127.0.0.1/../secret.png",
        "/state.json/../../secret.png",
        "*",
    ],
)
def test_only_known_names_are_served(server: Server, path: str) -> None:
    host = f"127.0.0.1:{server.server_port}"
    assert ask(server, path, Host=host)[0] in (400, 404)


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "", "localhost"]
)
def test_another_name_is_refused(server: Server, host: str) -> None:
    """DNS rebinding: a name of somebody else's that leads to this address."""
    host = host.format(port=server.server_port)
    assert ask(server, "/state.json", Host=host)[0] == 421


def test_it_listens_on_the_loopback_address_only(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in others - {"127.0.0.1"}:
        with pytest.raises(OSError):
            socket.create_connection((str(address), server.server_port), timeout=1).close()


@pytest.mark.skipif(not hasattr(os, "O_NOFOLLOW"), reason="no such links here")
def test_links_and_other_contents_are_not_served(server: Server, directory: Path) -> None:
    (directory / "best.png").unlink()
    (directory / "best.png").symlink_to(directory.parent / "secret.png")
    assert ask(server, "/best.png")[0] == 404
    (directory / "best.png").unlink()
    (directory / "best.png").write_text("<script>alert(1)</script>")
    assert ask(server, "/best.png")[0] == 404
    (directory / "best.png").unlink()
    os.mkfifo(directory / "best.png")
    assert ask(server, "/best.png")[0] == 404


@pytest.mark.parametrize(
    "contents",
    [
        b"",
        b"[]",
        b"{",
        b"\xff\xfe",
        b'{"evaluations": "many", "improvements": [[1], 2], "parameters": {"a": 1}}',
        b'{"evaluations": 1e400, "best_loss": NaN, "improvements": [[NaN, 1], [2, 0.5]]}',
        b'{"evaluations": 1e999, "seconds": 1e999, "improvements": [[1, 1e999], [-1e999, 2]]}',
        b'{"evaluations": 1%s, "budget": 1%s, "improvements": [[1, 2%s]]}' % ((b"0" * 400,) * 3),
        b"best_loss,seconds\n1e999,1e999\n0.5,1%s\n" % (b"0" * 400),
        b"[" * 100_000,
    ],
)
@pytest.mark.parametrize("name", ["run.json", "curve.csv", "run.ckpt"])
def test_damaged_files_are_not_shown(
    server: Server, directory: Path, name: str, contents: bytes
) -> None:
    (directory / name).write_bytes(contents)

    def refuse(constant: str) -> None:
        raise AssertionError(f"no JSON: {constant}")

    status, body, _ = ask(server, "/state.json")
    state = json.loads(body, parse_constant=refuse)
    assert status == 200
    assert all(len(point) == 2 for point in state["improvements"])
    assert all(abs(value) < 2**53 for value in state.values() if isinstance(value, int | float))


def test_an_empty_directory_and_none(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "later"):
        server, url = serve(path)
        assert url == f"http://127.0.0.1:{server.server_port}/"
        assert json.loads(ask(server, "/state.json")[1])["state"] == "not begun"
        assert ask(server, "/target.png")[0] == 404
        server.close()


def test_what_is_no_directory_and_no_port(tmp_path: Path, server: Server) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OptionError, match="is no directory"):
        serve(tmp_path / "file")
    with pytest.raises(OptionError, match="from 0 to 65535, not 70000"):
        serve(tmp_path, 70_000)
    with pytest.raises(OSError, match="in use"):
        serve(tmp_path, server.server_port)


def many_pixels(width: int, height: int) -> bytes:
    """PNG that says so many pixels, in a thousandth of their bytes."""
    rows = zlib.compressobj(1)
    row = bytes(1 + -(-width // 8))
    data = b"".join(rows.compress(row) for _ in range(height)) + rows.flush()
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", data), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def test_pictures_of_too_many_pixels_are_not_decoded(
    server: Server, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """169 million pixels in 20 kB: the header says so, and nothing more is read."""

    def decoded(*_: object) -> None:
        raise AssertionError("decoded")

    for name in ("target.png", "best.png"):
        (directory / name).write_bytes(many_pixels(13_000, 13_000))
    monkeypatch.setattr(ImageFile.ImageFile, "load", decoded)
    for name in ("target.png", "best.png"):
        assert ask(server, f"/{name}")[0] == 404
