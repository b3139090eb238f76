"""A page that shows a run while it goes on, on 127.0.0.1 alone; it writes and executes nothing."""

from __future__ import annotations

from fide_lab.watch.server import Server, serve

__all__ = ["Server", "serve"]
