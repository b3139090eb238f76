"""Hypotheses that a learned model has of this picture: where a run begins, if there is a model.

The first generation renders some; the best distinct ones are the starts of searches, as wide as the
hypotheses around them.  All other moves but `Refine` and `Resample` come after all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from typing import ClassVar, TypeAlias

import numpy as np

from fide_plugins.runtime.schema import Plain, Schema, Sides, Stateful, array, flag, maybe, real
from fide_plugins.search.mixed import Axes
from fide_plugins.search.moves import AFTER_DESCENT, Known, Move, Start
from fide_plugins.search.scene import Exchangeability
from fide_plugins.types import Float64, Indices, Posterior

_TYPICAL = 0.01  # of the median loss above the best: a difference of it divides a likelihood by e
_EXCLUDED = 0.01  # relative likelihood below which an answer takes no hypotheses
_MODE_NEAREST = 0.1  # of all hypotheses, whose spread says how far "near" is on each axis
_MODE_NARROWEST = 1e-3  # standard deviation


def probabilities(
    losses: Sequence[float],
    X: Float64,
    hypotheses: Float64,
    typical: float | None,
    noise: float | None,
    exchangeability: Exchangeability,
    axes: Axes,
) -> Float64:
    """Probabilities (m,) of answers X (m, d) with these losses; they sum to 1.

    p_m ~ (share of hypotheses that are nearest to m) * exp(-(L_m - L_best) / T), where T is the
    noise of a loss, or a hundredth of the median loss of rendered draws above that of the best
    answer, if this is larger.  Answers that the second factor excludes take no hypotheses from the
    others.

    hypotheses: (n, d), draws from the posterior.
    typical: median loss of draws; None: not known, and the best answer alone is likely.
    noise: standard deviation of a loss; None: not known.
    """
    best = min(losses)
    excess = np.asarray(losses, np.float64) - best
    scale = max(noise or 0.0, 0.0 if typical is None else _TYPICAL * (typical - best))
    likelihood = np.exp(-excess / scale) if scale > 0 else np.asarray(excess == 0, np.float64)
    kept = np.flatnonzero(likelihood >= _EXCLUDED)
    mass = np.zeros(len(X))
    mass[kept] = likelihood[kept]
    if len(kept) > 1:
        mass[kept] *= _nearest_shares(X[kept], hypotheses, exchangeability, axes)
    total = float(mass.sum())
    return mass / total if total > 0 else likelihood / likelihood.sum()


def _nearest_shares(
    X: Float64, hypotheses: Float64, exchangeability: Exchangeability, axes: Axes
) -> Float64:
    """Shares (m,) of the hypotheses (n, d) that are nearest to each of the answers X (m, d).

    Axes count by how narrow the hypotheses are around the answers, so that what the picture does
    not show decides nothing.
    """

    def squares(x: Float64) -> Float64:
        matched = hypotheses
        if exchangeability.blocks is not None:
            matched = np.stack([exchangeability.aligned(one, x) for one in hypotheses])
        return np.square(axes.difference(matched, x))

    apart = np.stack([squares(x) for x in X])  # (m, n, d)
    n = max(2, int(_MODE_NEAREST * len(hypotheses)))
    near = [each[np.argsort(each.sum(axis=1))[:n]].mean(axis=0) for each in apart]
    variance = np.maximum(np.mean(near, axis=0), _MODE_NARROWEST**2)  # (d,)
    nearest = (apart / variance).sum(axis=2).argmin(axis=0)
    return np.bincount(nearest, minlength=len(X)) / len(hypotheses)


_RENDERED = 48
_RENDERED_SETS = 8  # and where some were refined
_BESIDE_REFINED = 3  # of those: draws, whose median loss one odd draw does not move
_SEARCHED = 4  # of those rendered
_COMPLETED = 30  # candidates with what the best one of those has, and others leave open
_APART = 0.15  # of the unit cube, in some parameter: other hypotheses
_BETTER = 0.1  # of the typical loss
_FOREIGN = 0.045  # of the typical loss: more of it is no render's
_H_NARROWEST, _WIDEST, _WIDEST_SET = 0.02, 1 / 6, 0.06  # standard deviations
_AFTER_DESCENT, _OPEN = 0.02, 0.05  # at most, where descents have ended; but where it is wider
_NARROWEST_REFINED = 0.006  # descents through an emulator end near each other


class Hypotheses(Move, Stateful):
    """Points of the cube that a model takes for possible; none without a model.

    posterior: draws x (n, d), which say how probable an answer is, and refined points.
    sets: whether they are sets of exchangeable blocks.
    place: points (n, d) as they are rendered: integers and choices in their cells.
    narrow: whether those that wait are where descents ended.
    floor: loss that no candidate removes, as far as is known; covered: whether renders have a
        coverage: then their losses say enough of each parameter, and nothing is completed.  Both
        are set before each decision.
    typical: median loss of the draws that were rendered; None where it is not known.

    Of a photograph, a second generation completes the best of those rendered: what hypotheses that
    agree with it leave open is drawn again (`mixed_with`), since draws of all parameters at once
    hardly have all of it right.
    """

    name = "learned"
    from_incumbent = False
    has_more = False
    SCHEMA: ClassVar[dict[str, Schema]] = {
        "x": array("n", "d", low=0.0, high=1.0),
        "refined": array("refined", "d", low=0.0, high=1.0),
        "waiting": array("waiting", "d", low=0.0, high=1.0),
        "typical": maybe(real()),
        "narrow": flag,
        "completed": flag,
        "before": array("before", "d", low=0.0, high=1.0),
        "losses_before": array("before"),
    }

    def __init__(
        self,
        posterior: Posterior | None,
        dim: int,
        *,
        sets: bool = False,
        place: Callable[[Float64], Float64] = np.copy,
    ) -> None:
        self._sets, self._place, self._dim = sets, place, dim
        self.floor, self.covered = 0.0, False
        self.begin(posterior)

    def begin(self, posterior: Posterior | None) -> None:
        """Begin with those of a target; None: there are none."""
        nothing = np.empty((0, self._dim))
        self.x, refined = posterior or Posterior(nothing)
        self._refined = nothing if refined is None else refined
        self.narrow, self._completed = False, False
        self._before, self._losses_before = nothing, np.empty(0)  # rendered, best first
        self._waiting = nothing  # starts that were not searched yet, best first
        self.typical: float | None = None

    @property
    def available(self) -> bool:
        """Whether there are any."""
        return len(self.x) > 0

    @property
    def may_complete(self) -> bool:
        """Whether what they leave open is drawn again."""
        return self.available and not self.covered

    @property
    def posterior(self) -> Posterior | None:
        """What it began with; None: there were none."""
        return Posterior(self.x, self._refined) if self.available else None

    @property
    def waiting(self) -> bool:
        """Whether a search can begin at another one."""
        return len(self._waiting) > 0

    @property
    def strict_above(self) -> float | None:
        """Loss above which a search is no better than a start: a part of the typical one.

        None where that is unknown, or not positive: losses of the user's own may be of any sign.
        """
        if self.typical is None or self.typical <= 0:
            return None
        return self.floor + _BETTER * max(0.0, self.typical - self.floor)

    @property
    def are_foreign(self) -> bool:
        """Whether much of their losses is a difference that no render removes."""
        return self.typical is not None and self.floor > _FOREIGN * self.typical

    def possible(self, known: Known) -> bool:
        """Whether there are any."""
        return self.available

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Those that are rendered first, (m, d): what was refined, the best first, and draws.

        In the second generation those that complete the best one.
        """
        if len(self._before):
            best = self._before[0]
            opened = open_parameters(best, self.x, known.axes)
            return mixed_with(best, self.x, opened, _COMPLETED, rng)
        few = self._sets or len(self._refined) > 0
        refined = self._refined[: _RENDERED_SETS - _BESIDE_REFINED]
        draws = self.x[: (_RENDERED_SETS if few else _RENDERED) - len(refined)]
        return np.concatenate([refined, draws])

    def complete(self, found: Sequence[tuple[float, Float64]], known: Known) -> bool:
        """Whether a generation comes that completes the best of those found, as loss and x (d,)."""
        losses, x = (np.array(one) for one in zip(*found, strict=True))
        order = np.argsort(losses, kind="stable")
        if not self.may_complete or self._completed or self._sets:
            return False
        if not open_parameters(x[order[0]], self.x, known.axes):
            return False
        self._completed, self._before, self._losses_before = True, x[order], losses[order]
        return True

    @property
    def before(self) -> list[tuple[float, Float64]]:
        """What was found before the present generation, as loss and x (d,)."""
        return list(zip(self._losses_before.tolist(), self._before, strict=True))

    def learn(
        self,
        found: Sequence[tuple[float, Float64]],
        best: Float64,
        distance: Callable[[Float64, Float64], float],
    ) -> None:
        """Choose starts: the best distinct ones of those found, as loss and x (d,).

        best: (d,), the best of all, also where no image is known.
        """
        ordered = sorted(found, key=lambda one: one[0])
        chosen = [ordered[0][1] if self._completed else best]
        for _, x in ordered:
            if (
                len(chosen) < (1 if self._sets else _SEARCHED)
                and min(distance(x, y) for y in chosen) >= _APART
            ):
                chosen.append(x)
        self._waiting = np.array(chosen)
        if self.typical is not None:
            return
        losses = [loss for loss, x in found if self._is_among(x, self.x)]
        typical = float(np.median(losses)) if losses else np.inf
        self.typical = typical if np.isfinite(typical) else None

    def replace(self, ends: Float64) -> None:
        """Let searches begin where descents from the best ended, (m, d), the best first."""
        self._waiting, self.narrow = ends.copy(), True

    def next(self, known: Known, before: Start) -> Start:
        """Begin at the next one; where `before` is the same place, the search is no wider."""
        x, self._waiting = self._waiting[0], self._waiting[1:]
        start = self.begin_at(known, x)
        if not np.array_equal(x, before.mean):
            return start
        return replace(start, std=np.minimum(start.std, before.std))

    def is_wider(self, posterior: Posterior, known: Known, start: Start) -> bool:
        """Whether a search from the first one of a target is wider, on the whole, than `start`."""
        others = copy(self)
        others.begin(posterior)
        first = others._refined if len(others._refined) else others.x
        std = others.begin_at(known, first[0]).std
        return bool(np.log(start.std).sum() < np.log(std).sum())

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin at x (d,), as wide as the hypotheses around it."""
        std = self.spread(x, known)
        if self.narrow:
            narrow = np.minimum(std, AFTER_DESCENT if self.covered else _AFTER_DESCENT)
            std = narrow if self.covered else np.where(std > _OPEN, std, narrow)
        return Start(x, std, strict_above=self.strict_above)

    def spread(self, x: Float64, known: Known) -> Float64:
        """Standard deviations (d,) around x (d,) of the hypotheses that are nearest to it."""
        refined = self._is_among(x, self._refined)
        around = np.concatenate([self._refined, self.x[:1]]) if refined else self.x
        others = np.stack([known.exchangeability.aligned(one, x) for one in around])
        squares = np.square(known.axes.difference(others, x))  # (n, d)
        order = np.argsort(squares.sum(axis=1), kind="stable")
        nearest = squares[order[: max(2, int(_MODE_NEAREST * len(others)))]]
        spread = np.sqrt(nearest.mean(axis=0))
        low = _NARROWEST_REFINED if refined else _H_NARROWEST
        return np.asarray(np.clip(spread, low, _WIDEST_SET if self._sets else _WIDEST), np.float64)

    def _is_among(self, x: Float64, points: Float64) -> bool:
        """Whether a candidate x (d,), as it was rendered, is one of the points (n, d)."""
        return bool((self._place(points) == x).all(axis=1).any())

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError for what it cannot have given."""
        super().load_state_dict(state, {"d": self._dim})
        for name in ("x", "_refined", "_waiting", "_before"):
            setattr(self, name, getattr(self, name).reshape(-1, self._dim))


_AGREE = 0.05  # of the unit cube: the same in a parameter
_AGREEING = 0.25  # of all hypotheses: those that agree with the incumbent in the others
_OPEN_SHARE = 0.25  # of these, at least, differ from the incumbent in a parameter that is open
_WIDE, _NARROW = 1 / 3, 1 / 16  # of sigma0, in the parameters that were drawn, in all others


Opened: TypeAlias = list[tuple[Indices, Float64]]
"""Of each parameter that is open: its axes, and what (m, axes) hypotheses have there, sorted."""


def open_parameters(x: Float64, hypotheses: Float64, axes: Axes) -> Opened:
    """What those hypotheses (n, d) leave open that agree with a point (d,) in the rest."""
    apart = axes.difference(hypotheses, x)
    agree = np.column_stack([apart[:, some].max(axis=1) <= _AGREE for some in axes.axes_of])
    opened = []
    for i, some in enumerate(axes.axes_of):
        others = agree.sum(axis=1) - agree[:, i]
        nearest = np.argsort(-others, kind="stable")[: max(1, int(_AGREEING * len(hypotheses)))]
        differ = nearest[~agree[nearest, i]]
        if len(differ) >= _OPEN_SHARE * len(nearest):
            values = hypotheses[differ][:, some]
            opened.append((some, values[np.lexsort(values.T[::-1])]))
    return opened


def mixed_with(
    x: Float64, hypotheses: Float64, opened: Opened, n: int, rng: np.random.Generator
) -> Float64:
    """Copies (n, d) of a point (d,) with parameters of hypotheses (m, d) where these are open.

    Half of them in a single parameter, spread over what is possible there, and half of them in
    several at once, all of one hypothesis.
    """
    copies = np.tile(x, (n, 1))
    if not opened:
        return copies
    singles = rng.permutation(np.arange((n + 1) // 2))
    for i, row in enumerate(copies[::2]):
        axes, values = opened[singles[i] % len(opened)]
        strata = -(-len(singles) // len(opened))  # draws of this parameter, one from each
        quantile = (singles[i] // len(opened) + rng.random()) / strata
        row[axes] = values[min(int(quantile * len(values)), len(values) - 1)]
    for row in copies[1::2]:
        other = hypotheses[rng.integers(len(hypotheses))]
        some = rng.random(len(opened)) < 0.5
        some[rng.choice(len(opened), min(2, len(opened)), replace=False)] = True
        for axes, _ in (one for one, taken in zip(opened, some, strict=True) if taken):
            row[axes] = other[axes]
    return copies


class Resample(Move):
    """What a learned model leaves open, drawn again around the best so far, see `mixed_with`."""

    name = "resample"
    prior_gain = 0.5

    def __init__(self, hypotheses: Hypotheses) -> None:
        self._hypotheses = hypotheses

    def possible(self, known: Known) -> bool:
        """Whether there are hypotheses that leave anything open, and no blocks are exchangeable."""
        if not self._hypotheses.available or known.exchangeability.blocks is not None:
            return False
        return len(open_parameters(known.current.x, self._hypotheses.x, known.axes)) > 0

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent; every second one differs in a single parameter."""
        x, others = known.current.x, self._hypotheses.x
        return mixed_with(x, others, open_parameters(x, others, known.axes), n, rng)

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Wide in what was drawn, narrow in what was found before."""
        start = known.start_at(x, wide=_WIDE, narrow=_NARROW)
        return replace(start, strict_above=self._hypotheses.strict_above)
