"""What an optimizer does when its images are compared in another way from now on.

No loss and no token of before is kept; the best renders are (`comparison.kept`), and are compared
again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fide_plugins.population import Memory
from fide_plugins.search.moves import Start
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

_NARROWEST = 1 / 3  # of the first standard deviation, with which a search begins again


def adapt_light(optimizer: FIDE) -> None:
    """Set more or less of the light aside, where the best renders say so (`comparison.auto`).

    It is considered after 1, 2, 4, 8 ... generations of a search, once its blurs are chosen, and
    where the target has other colors than the first renders.  These also say how soft a camera
    has made a photograph.
    """
    evaluator, kept = optimizer.evaluator, optimizer.state.kept
    generations = optimizer.state.population.generations
    if kept is None or not len(kept) or kept.given.any():
        return
    if not (evaluator.adapts_light or evaluator.adapts_blur):
        return
    if generations == kept.considered or generations & (generations - 1):
        return
    if optimizer.state.scales.useful is None and not kept.covered:
        return  # blurs are chosen by the first renders, in their own light
    kept.considered = generations
    assert evaluator.comparison is not None and kept.images is not None
    comparison, before = evaluator.comparison, evaluator.comparison.options
    if kept.other_colors is None:
        kept.other_colors = comparison.has_other_colors(kept.images)
        if evaluator.adapts_blur:
            comparison.camera = comparison.camera_blur(kept.images)
    if kept.other_colors and evaluator.adapts_light:
        comparison.light = comparison.light_that_explains(kept.images)
    if comparison.options != before:
        comparison.begin_again(kept.images)
        compare_again(optimizer)


def compare_again(optimizer: FIDE, std: Float64 | None = None) -> None:
    """Forget losses and tokens of another comparison; begin a search at the best render.

    std: (dim,), with which it begins; None: as wide as the present one, but at least a third of the
        first.
    """
    state, evaluator, kept = optimizer.state, optimizer.evaluator, optimizer.state.kept
    assert kept is not None and kept.images is not None
    if std is None:
        first = np.broadcast_to(optimizer.sigma0, optimizer.dim)
        std = np.clip(state.search.std, _NARROWEST * first, first)
    before, given = kept.losses.copy(), kept.losses[kept.given]
    compared = evaluator.evaluate(len(kept), kept.images, note=state.needs_floor)
    compared.losses[kept.given] = given
    order = np.argsort(compared.losses, kind="stable")
    results = list(compared.of(kept.x))
    start, now = Start(kept.x[order[0]].copy(), std), state.evaluations
    blurs = state.scales.left
    hypotheses = state.moves.hypotheses
    posterior = typical = None
    if hypotheses is not None and state.moves.descends:
        posterior, typical = hypotheses.posterior, hypotheses.typical
    change = float(np.median(compared.losses)) / max(float(np.median(before)), 1e-300)
    state.retarget(evaluator.target_tokens, start, posterior)
    if hypotheses is not None and posterior is not None and typical is not None:
        hypotheses.typical = change * typical
    state.memory = Memory(optimizer.options.memory_mb)
    for i in order:
        state.evaluations = int(kept.evaluations[i])
        state.record(*results[i])
    state.begin_after(now)
    state.comparisons += 1
    kept.rank(compared.losses)
    if not state.begin_descents() and blurs:
        state.scales.left = blurs
        state.begin_at_blur()


def compare_first_at(optimizer: FIDE, size: tuple[int, int] | None) -> None:
    """Compare renders of (h, w) pixels from now on, before any was told; None: the target's."""
    optimizer.evaluator = optimizer.evaluator.at_size(size)
    optimizer.state.moves.known.target = optimizer.evaluator.target_tokens


def compare_finer(optimizer: FIDE, size: tuple[int, int] | None, x: Float64, std: Float64) -> None:
    """Forget all losses and tokens, which are of coarser renders; begin a search at x (d,).

    size: (h, w) of renders from now on; None: that of the target.  std: (d,).
    """
    state = optimizer.state
    if size != optimizer.evaluator.size:
        optimizer.evaluator = optimizer.evaluator.at_size(size)
    if state.kept is not None:
        state.kept = type(state.kept)(optimizer.dim)
    state.retarget(optimizer.evaluator.target_tokens, Start(x.copy(), std), None)
    state.memory = Memory(optimizer.options.memory_mb)
    state.comparisons += 1
