"""The page of a run, in the browser while the command goes on: `--live`."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fide_plugins.cli.messages import note, plain

__all__ = ["open_page", "page_of"]


@contextmanager
def page_of(out: Path) -> Iterator[None]:
    """Within this block, the page of a run directory is served and open in the browser."""
    from fide_plugins.watch import serve

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
