"""Which tasks, optimizers, encoders and losses can be used on this machine: each is tried once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from fide_plugins.cli.messages import plain
from fide_plugins.runtime import laboratory

__all__ = ["KINDS", "OF_A_MODEL", "WITH_WEIGHTS", "names", "problems"]

KINDS = ("tasks", "optimizers", "encoders", "losses")
WITH_WEIGHTS = ("encoders", "losses")  # kinds that may need weights; to try them takes seconds
OF_A_MODEL = ("learned",)  # encoders that read a model of the user's, which is named with them
_VARIANTS = {"losses": ("lpips:squeeze", "lpips:vgg")}  # variants with their own weights
_SIDE = 32  # pixels, side of the test images


def names(kind: str) -> list[str]:
    """Names of all tasks, optimizers, encoders or losses."""
    import fide_tasks
    from fide_plugins import encoders, losses

    if kind == "optimizers":
        return list(laboratory.module(kind).names()) if laboratory.is_installed() else ["fide"]
    lists = {"tasks": fide_tasks, "encoders": encoders, "losses": losses}
    return sorted(lists[kind].names())


def problems(kind: str) -> dict[str, str | None]:
    """For each name of a kind: None if it can be used here, otherwise the reason why not.

    Each task renders a frame, each encoder and each loss processes an image, each optimizer
    proposes candidates.  Variants with their own weights are tried too.  Nothing is downloaded.
    """
    results: dict[str, str | None] = {}
    for name in sorted({*names(kind), *_VARIANTS.get(kind, ())}):
        try:
            _CHECKS[kind](name)
            results[name] = None
        except Exception as error:  # any error is a reason
            results[name] = plain(error) or type(error).__name__
    return results


def _image() -> Any:
    import numpy as np

    return np.linspace(0, 1, _SIDE * _SIDE * 3, dtype=np.float32).reshape(_SIDE, _SIDE, 3)


def _try_task(name: str) -> None:
    import fide_tasks

    fide_tasks.make(name, size=_SIDE).check()


def _try_optimizer(name: str) -> None:
    from fide_plugins.fide import FIDE

    optimizer = FIDE if name == "fide" else partial(laboratory.module("optimizers").make, name)
    optimizer(2, _image(), seed=0).ask()


def _try_encoder(name: str) -> None:
    from fide_plugins import encoders

    encoders.make(name)(_image()[None])


def _try_loss(name: str) -> None:
    from fide_plugins import losses

    losses.make(name, _image())(_image()[None])


_CHECKS: dict[str, Callable[[str], None]] = {
    "tasks": _try_task,
    "optimizers": _try_optimizer,
    "encoders": _try_encoder,
    "losses": _try_loss,
}
