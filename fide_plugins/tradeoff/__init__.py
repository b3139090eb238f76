"""Speed against accuracy: sweep the settings that matter, and say which to use for how much time.

`grid` makes comparisons of settings, `front` knows what came out and which of it nothing else
beats, `show` writes tables and figures.
"""

from __future__ import annotations

from fide_plugins.tradeoff.front import Setting, best_within, front, read
from fide_plugins.tradeoff.grid import Grid

__all__ = ["Grid", "Setting", "best_within", "front", "read"]
