"""What other processes are given to do; a module of its own, which they can import by name."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

LONG = 60.0


def work(item: Any) -> Any:
    """Die, or say who one is and sleep, or just say who one is."""
    if item == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if isinstance(item, Path):
        item.write_text(str(os.getpid()))
        time.sleep(LONG)
    return os.getpid(), item


def lost(item: Any, why: str) -> Any:
    return None, item
