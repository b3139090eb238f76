"""The page of a run, in the browser while the command goes on: `--live`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fide_plugins.cli.messages import note, plain

__all__ = ["page_of"]


@contextmanager
def page_of(out: Path) -> Iterator[None]:
    """Within this block, the page of a run directory is served and open in the browser."""
    import webbrowser

    from fide_plugins.watch import serve

    server, url = serve(out)
    try:
        note(f"{url} shows {plain(out)} until the command ends")
        webbrowser.open(url)
        yield
    finally:
        server.close()
