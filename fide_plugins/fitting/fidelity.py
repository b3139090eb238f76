"""How fine renders may be: a `Fidelity`, and workers that are asked as a `Schedule` says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from fide_plugins.errors import OptionError
from fide_plugins.fitting.rendering import Outcome, Task, Workers
from fide_plugins.fitting.schedule import Schedule
from fide_plugins.renderers.keywords import keywords_of
from fide_plugins.validation.points import whole_number

if TYPE_CHECKING:
    from collections.abc import Callable

    from fide_plugins.fide import FIDE


@dataclass(frozen=True, slots=True)
class Fidelity:
    """How coarse a fit may ask its renderer to be; raises OptionError for what is no range.

    size: fewest and most pixels of the shorter side; a target's own side is the most, too.
    samples: fewest and most samples of a pixel.  None: none but the finest.
    """

    size: tuple[int, int] | None = None
    samples: tuple[int, int] | None = (1, 64)

    def __post_init__(self) -> None:
        """Check both."""
        for name in ("size", "samples"):
            pair = getattr(self, name)
            if pair is None:
                continue
            if not isinstance(pair, Sequence) or len(pair) != 2:
                raise OptionError(f"{name} must be two numbers, such as (1, 64), not {pair!r}")
            low, high = (whole_number(f"{name} of Fidelity", one, 1) for one in pair)
            if low > high:
                raise OptionError(f"{name} must be the least and the most, not {pair!r}")
            object.__setattr__(self, name, (low, high))


def schedule_for(
    render: Callable[..., Any], fidelity: Fidelity | bool | None, optimizer: FIDE
) -> Schedule | None:
    """What a fit asks of a renderer; None for one that takes neither size, samples nor a seed.

    fidelity: None: samples and seed by the renderer's signature, and the full size, since small
        ones have saved no time where it was measured; False: the finest only.  Raises OptionError.
    """
    if not (fidelity is None or fidelity is False or isinstance(fidelity, Fidelity)):
        raise OptionError(f"fidelity must be Fidelity(size=..., samples=...), not {fidelity!r}")
    takes = keywords_of(render, declared=isinstance(fidelity, Fidelity))
    if isinstance(fidelity, Fidelity) and not {"size", "samples"} & set(takes):
        raise OptionError(
            "fidelity needs a renderer that takes size=(h, w) or samples=n as keyword arguments, "
            "or a command with {width} {height} or {samples}; give it one, or leave fidelity out"
        )
    if not takes:
        return None
    most = takes.get("samples")
    most = most if isinstance(most, int) and most > 0 else 64
    if fidelity is None:
        fidelity = Fidelity(None, (1, most))
    elif fidelity is False:
        fidelity = Fidelity(None, (most, most))
    return Schedule(
        list(takes),
        _sizes(optimizer, fidelity.size if "size" in takes else None),
        (1, 1) if "samples" not in takes else fidelity.samples or (most, most),
        optimizer,
    )


def _sizes(optimizer: FIDE, limits: tuple[int, int] | None) -> list[Any]:
    """Sizes (h, w) of renders, from the least shorter side to the most, each half of the next."""
    views = [view.size for view in optimizer.views.views]
    if len(set(views)) > 1:
        return [views]
    full = views[0]
    if limits is None or optimizer.loss_name is None:
        return [full]
    most = min(min(full), limits[1])
    least = min(most, limits[0])
    halvings = math.floor(math.log2(most / least) + 0.3)
    sides = [max(least, round(most / 2**i)) for i in range(halvings, 0, -1)] + [most]
    share = [one / min(full) for one in sides]
    return [(round(full[0] * one), round(full[1] * one)) for one in share]


class WorkersAsked(Workers):
    """Workers whose every render is asked for as a schedule says, and counted."""

    def __init__(self, workers: Workers, schedule: Schedule) -> None:
        self._workers, self._schedule, self.number = workers, schedule, workers.number
        self._asked: dict[Task, tuple[int, int]] = {}
        self.began, self.close = workers.began, workers.close  # type: ignore[method-assign]

    @property
    def usable(self) -> int:
        """As of the workers."""
        return self._workers.usable

    def submit(self, x: Any) -> Task:
        """Render the point x (d,)."""
        task = self._workers.submit((x, self._schedule.request()))
        self._asked[task] = self._schedule.k, self._schedule.samples
        return task

    def outcome(self, task: Task) -> Outcome:
        """Image, or what went wrong, and how fine it was asked for."""
        fineness = self._asked.pop(task)
        self._schedule.pay(*fineness)
        return replace(self._workers.outcome(task), fineness=fineness)

    def abandon(self, task: Task) -> None:
        """As of the workers."""
        self._schedule.pay(*self._asked.pop(task))
        self._workers.abandon(task)
