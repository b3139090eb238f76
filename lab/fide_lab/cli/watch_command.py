"""Show a run in the browser while it goes on.

    fide watch runs/mine
    fide watch runs/mine --port 8765 --no-browser

DIR is the directory of a run, of `fide run` or `fide fit` (--out). The page is served on 127.0.0.1,
to this machine only, until Ctrl-C. Nothing is written.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fide_lab.watch import serve
from fide_plugins.cli.arguments import path
from fide_plugins.cli.terminal import complain, note, plain


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide watch``."""
    add = parser.add_argument
    add("directory", type=path, metavar="DIR", help="directory of a run")
    add("--port", type=int, default=0, metavar="P", help="port of 127.0.0.1 (any that is free)")
    add("--no-browser", action="store_true", help="only print the address")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    if not args.directory.is_dir():
        return complain("fide watch", f"there is no directory {plain(args.directory)}")
    try:
        server, url = serve(args.directory, args.port)
    except (OSError, ValueError, OverflowError) as error:
        return complain("fide watch", f"cannot serve on port {args.port}: {plain(error)}")
    print(f"{url} shows {plain(args.directory)}; Ctrl-C ends it", flush=True)
    if not args.no_browser:
        open_page(url)
    try:
        threading.Event().wait()
    finally:
        server.close()
    return 0


@contextmanager
def page_of(out: Path) -> Iterator[None]:
    """Within this block, the page of a run directory is served and open in the browser."""
    server, url = serve(out)
    try:
        note(f"{url} shows {plain(out)} until the command ends")
        open_page(url)
        yield
    finally:
        server.close()


def open_page(url: str) -> None:
    """Open the browser, without waiting: some return when their window is closed."""
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
