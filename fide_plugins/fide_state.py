"""All of an optimizer that a checkpoint must hold, as nested dicts of arrays and numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fide_plugins.errors import LossError
from fide_plugins.fide_form import check_sizes, check_state
from fide_plugins.images import Float32
from fide_plugins.ledger import Ledger
from fide_plugins.points import Float64
from fide_plugins.rendered import Rendered
from fide_plugins.search.cma_es import CMAES
from fide_plugins.search.relocate import Stage
from fide_plugins.solution import Solution

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

__all__ = ["pack", "remake", "restore"]

T = TypeVar("T", bound="FIDE")

_PLAIN_STATE = (
    "evaluations",
    "not_finite",
    "times",
    "_clipped",
    "_best_index",
    "_best_mean",
    "_best_search",
    "_searches",
    "_over_at",
)


def pack(optimizer: FIDE) -> dict[str, Any]:
    """Return what `restore` needs, and what the optimizer was made with."""
    optimizer._ledger.make_proposals()  # which may change the proposer
    return {
        "dim": optimizer.dim,
        "target": optimizer.target,
        "options": asdict(optimizer.options),
        "x0": optimizer.x0,
        "sigma0": optimizer.sigma0,
        "seed": optimizer.seed,
        "popsize": optimizer.popsize,
        "encoder": optimizer._encoder.version,
        "loss": optimizer._loss_name,
        "loss_version": _version_of_loss(optimizer),
        "best": None if optimizer._best is None else asdict(optimizer._best),
        "lessons": [asdict(lesson) for lesson in optimizer._lessons],
        "guest": None if optimizer._guest is None else list(optimizer._guest),
        "rng": optimizer._rng.bit_generator.state,
        "proposer": None if optimizer._proposer is None else optimizer._proposer.state_dict(),
        "search": optimizer._search.state_dict(),
        "found": None if optimizer._found is None else asdict(optimizer._found),
        "stage": optimizer._stage.value,
        "history": np.array(optimizer._progress.history, np.float64),
        "relocation": optimizer._relocation.state_dict(),
        "trust": optimizer._trust.state_dict(),
        "ledger": optimizer._ledger.state_dict(),
        **{name: getattr(optimizer, name) for name in _PLAIN_STATE},
    }


def remake(
    cls: type[T], state: Mapping[str, Any], loss: str | Callable[..., object] | None, device: str
) -> T:
    """Make another optimizer that stands where `pack` was called.

    loss: needed where it was not a name.
    """
    check_sizes(state)
    o = {**state["options"], "popsize": state["popsize"]}
    o["schedule"], o["views"] = tuple(o["schedule"]), tuple(o["views"])
    if loss is None:
        loss = state["loss"] if state["loss"] is not None else _not_stored
    optimizer = cls(
        state["dim"],
        state["target"],
        loss=loss,
        x0=state["x0"],
        sigma0=state["sigma0"],
        seed=state["seed"],
        device=device,
        **o,
    )
    restore(optimizer, state)
    return optimizer


def _not_stored(images: Float32) -> Float64:
    raise LossError(
        "this optimizer was saved with a callable as its loss, which a checkpoint cannot hold; "
        "give it again, load(path, loss=...), or tell losses"
    )


def _version_of_loss(optimizer: FIDE) -> str | None:
    """None for a user's own loss."""
    version: str | None = getattr(optimizer._loss, "version", None)
    return version


def restore(optimizer: FIDE, state: Mapping[str, Any]) -> None:
    """Put a new optimizer, made with the same arguments, where `pack` was called."""
    if state["encoder"] != optimizer._encoder.version:
        raise ValueError(
            f"features of the encoder {state['encoder']}; the one here is "
            f"{optimizer._encoder.version}"
        )
    if optimizer._loss_name is not None and optimizer._loss_name == state["loss"]:
        stored, own = state["loss_version"], _version_of_loss(optimizer)
        if stored != own:
            raise ValueError(f"values of the loss {stored}; the one here is {own}")
    tokens, channels = optimizer.features_shape
    sides = {"d": optimizer.dim, "k": optimizer.popsize, "T": tokens, "C": channels}
    check_state(state, sides)
    for name in _PLAIN_STATE:
        setattr(optimizer, name, state[name])
    optimizer._best = None if state["best"] is None else Solution(**state["best"])
    device = optimizer._encoder.device
    optimizer._lessons = [Rendered.from_state(lesson, device) for lesson in state["lessons"]]
    found = state["found"]
    optimizer._found = None if found is None else Rendered.from_state(found, device)
    optimizer._guest = None if state["guest"] is None else (state["guest"][0], state["guest"][1])
    optimizer._rng.bit_generator.state = state["rng"]
    optimizer._search = CMAES.from_state(state["search"])
    optimizer._stage = Stage(state["stage"])
    optimizer._relocation.load_state_dict(state["relocation"], device)
    optimizer._trust.load_state_dict(state["trust"])
    optimizer._progress.goal = optimizer._relocation.goal
    optimizer._progress.history = state["history"].tolist()
    optimizer._ledger = Ledger.from_state(state["ledger"])
    if optimizer._proposer is not None:
        optimizer._proposer.load_state_dict(state["proposer"])
