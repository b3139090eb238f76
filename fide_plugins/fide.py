"""FIDE: feature-informed diffusion evolution (Algorithm 1 of the paper), by ask and tell.

=====================================  ======================================================
Algorithm 1                            here
=====================================  ======================================================
line 1, mu and Sigma                   `search.cma_es.CMAES`
line 2, the denoiser                   a `Proposer`: `proposers.linear`, `.forward`, `.diffusion`
line 4, sample                         `FIDE._draw_samples`
line 5, denoise                        `FIDE._propose`, of some of these samples
line 6, render                         the user, between `ask` (`asking`) and `tell`
line 7, features                       `FIDE.tell`, by an encoder
line 8, train                          `FIDE._train`; before a proposal, `Asking._train_early`
line 9, costs                          `FIDE.tell`, by a loss or the user
line 10, mu and Sigma                  `FIDE._update_search`
line 12, return mu                     `FIDE.recommend`
between two generations, steps         `Asking._make_steps`: a forward model trains, proposes
after a search, begin again            `State.finish_search`, `search.moves`
=====================================  ======================================================

The last two are beyond Algorithm 1.  The forward model of the steps (`proposers.steps`) is not the
forward proposer: that one trains in line 8 and proposes in line 5.

What other methods are, in these terms: CMA-ES is FIDE with nothing proposed
(``proposer="none"``); the published method is ``preset="paper"``; a direct inverse predictor is a
proposer without evolution (`baselines.posterior_sampler`).

All that changes while an optimizer runs is its `state` (`fide_plugins.state`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from fide_plugins import encoders
from fide_plugins.asking import Asking
from fide_plugins.comparing import adapt_light
from fide_plugins.comparison.kept import Kept
from fide_plugins.evaluation import Evaluator, Result
from fide_plugins.options import make_options
from fide_plugins.population import Candidate, Population
from fide_plugins.population.training_sample import TrainingSample, columns, in_order
from fide_plugins.proposers import channel_subsets, make_proposer, make_steps
from fide_plugins.proposers.image_gate import ImageGate
from fide_plugins.runtime.machine import timed
from fide_plugins.runtime.threads import Lock, one_at_a_time, one_thread
from fide_plugins.search.cma_es import default_popsize
from fide_plugins.search.memory import Memory
from fide_plugins.search.moves.policy import MovePolicy, Stage
from fide_plugins.search.one_search import Search, Setting
from fide_plugins.search.validity import validity_of
from fide_plugins.space import Space
from fide_plugins.state import State
from fide_plugins.types import Float64, Posterior
from fide_plugins.validation.points import (
    as_points,
    new_seed,
    number_of_parameters,
    standard_deviations,
    starting_point,
)
from fide_plugins.views.grain import Grain
from fide_plugins.views.same_images import SameImages

__all__ = ["FIDE"]


class FIDE(Asking):
    """Find parameters in [0, 1]^dim whose image is the target.

    Parameters
    ----------
    dim
        number of parameters, at least 1; or a `Space` of named parameters.
    target
        picture to find: (H, W, 3) or (H, W), uint8 in [0, 255] or float in [0, 1]; also a path, a
        PIL image or a torch tensor; or a list of them, one for each view (`fide_plugins.views`).
    loss
        name in `fide_plugins.losses`, or a callable from images to (n,) numbers; None: "mse".
        Used where `tell` gets images without losses.
    encoder
        name in `fide_plugins.encoders`, an encoder that `encoders.make` made, or a callable from
        images to (n, T, C) features; None: the preset's own.
    mask, weights
        which pixels count: (H, W) in [0, 1], or any gray picture; "alpha": that of the target; for
        views a list of them, None for a view without, or a single one for all, if they have its
        size; both: their product (`fide_plugins.views`).
    value_range
        two numbers, the values of target and renders that are black and white, or "auto"
        (`fide_plugins.views`); None: 0 and 1, for uint8 0 and 255.
    popsize
        candidates a generation, at least 4; None: the preset's own.
    x0
        (dim,), a guess: it is asked first, and the first search begins around it; with a `Space`
        also a dictionary of values, as its `decode` gives it.  None: the search begins around 0.5
        in each parameter, which is not asked.
    sigma0
        its standard deviation there: one number, or one for each parameter.
    preset
        "fast", "balanced", "accurate", or "paper" for the published method.
    seed
        same seed, same run; None draws one.
    device
        of encoder, proposer and a named loss: "auto" takes CUDA where there is some for those that
        are networks; with none of them, an encoder and its tokens stay where the images are.
    learned
        model of this renderer, or its file, see `fide_plugins.learn`: its hypotheses of the target
        are rendered first, after x0 if that is given, and the best are where the first searches
        begin.
    constraints
        function of the parameters (a dictionary with a `Space`, else x of shape (dim,)) that
        returns True where they are valid, or margins: a number or several, <= 0 where they are.
        `ask` gives valid points only; those of the space's own `constraints` are respected, too.
    **options
        any other option, see `fide_plugins.options`.

    Any number of threads may ask and tell the same optimizer.

    Raises
    ------
    ImageError, OptionError, UnknownNameError
        all ValueErrors: the target or an option is not what it must be.
    """

    name = "fide"
    takes_space = True

    def __init__(
        self,
        dim: int | Space,
        target: object,
        *,
        loss: str | Callable[..., object] | None = None,
        encoder: str | Callable[..., object] | None = None,
        mask: object = None,
        weights: object = None,
        value_range: object = None,
        popsize: int | None = None,
        x0: object = None,
        sigma0: float | Float64 = 1 / 6,
        preset: str = "balanced",
        seed: int | None = None,
        device: str = "auto",
        learned: Any = None,
        constraints: Callable[[Any], object] | None = None,
        **options: Any,
    ) -> None:
        self.space = dim if isinstance(dim, Space) else None
        self.dim = number_of_parameters("dim", dim.dim if isinstance(dim, Space) else dim)
        named = {"encoder": encoders.name_of(encoder), "popsize": popsize}
        self.options = o = make_options(preset, {**named, **options})
        self.x0 = starting_point(x0, self.dim, self.space)
        self.guess = None if x0 is None else self.x0
        self.sigma0 = standard_deviations(sigma0, self.dim)
        self.seed = new_seed(seed)
        self.popsize = o.popsize or default_popsize(self.dim)
        self.validity = validity_of(self.space, constraints, self.seed)
        self.has_own_constraints = constraints is not None
        if self.validity is not None and self.guess is not None:
            self.validity.check_guess(self.guess)
        self.evaluator = Evaluator(
            target,
            loss,
            o.encoder if encoder is None else encoder,
            mask=mask,
            weights=weights,
            value_range=value_range,
            device=device,
            for_network=o.has_network,
            **o.comparison,
        )
        self.same_images = SameImages(self.popsize)
        self._lock = Lock()
        self._decision: tuple[bool | None, bool | None] = None, None
        self.begin_with(learned)

    # -- Algorithm 1 -------------------------------------------------------------------------------

    def _initial_state(self, posterior: Posterior | None = None) -> State:
        """Lines 1 and 2; posterior: of a learned model, where the search begins."""
        o, k = self.options, self.popsize
        subsets = channel_subsets(o.proposal, self.encoder)
        layout = None if self.space is None else self.space.layout
        setting = Setting(k, np.broadcast_to(self.sigma0, self.dim), o, layout, self.validity)
        groups: Sequence[Sequence[int]] | None = o.groups
        if groups is None and self.space is not None:
            groups = self.space.largest_family or None  # if there is none, they are tested for
        moves = MovePolicy(
            self.x0, setting.sigma0, popsize=k, target=self.target_tokens, channels=subsets[0],
            seed=self.seed, groups=groups, layout=layout, posterior=posterior,
        )  # fmt: skip
        moves.start = setting.valid_start(moves.start, 1)
        known = posterior is not None
        return State(
            rng=np.random.default_rng(self.seed),
            population=Population(),
            search=Search(moves.start, moves.goal, setting),
            moves=moves,
            gate=ImageGate(o, subsets, known=known),
            proposer=make_proposer(o, self.dim, k, self.seed, self.encoder, learned=known),
            steps=make_steps(o, self.dim, k, self.encoder, learned=known),
            memory=Memory(o.memory_mb),
            grain=Grain(self.views),
            kept=Kept(self.dim) if self.evaluator.comparison is not None else None,
        )

    def draw(self, population: Population, rng: np.random.Generator) -> None:
        """Draw a generation of the present stage, by `rng`, into a population; only these change.

        It is the optimizer's own population, or another one (`distributed.replica`).
        """
        state = self.state
        if state.stage is Stage.SEARCH:
            self._draw_samples(population, rng)
        else:
            x = state.draw_moves(rng)
            population.draw(x, x)

    def _draw_samples(self, population: Population, rng: np.random.Generator) -> None:
        """Lines 4 and 5: sample, and leave the last samples to the proposer, if it is ready."""
        state = self.state
        k = state.search.popsize
        x, z = state.search.sample(k, rng)  # line 4: (k, d), z ~ N(m, Sigma)
        ready = state.proposer is not None and state.proposer.ready
        n = k - state.gate.number(k, rng) if ready else k
        population.draw(x[:n], z[:n], z[n:], pair=state.search.distribution.draws_pair)
        self._propose_with(population, rng)  # line 5, of z[n:], when these are asked for

    def _propose_with(self, population: Population, rng: np.random.Generator) -> None:
        """Say how the population makes proposals."""
        proposer = self.state.proposer
        if proposer is not None:
            propose = partial(self._propose, search=self.state.search, rng=rng)
            population.propose_by(propose, singly=proposer.singly)

    def _propose(
        self, z: Float64, search: Search, rng: np.random.Generator
    ) -> tuple[Float64, Float64]:
        """Line 5: proposals x and their z, (m, d) each, from samples of N(m, Sigma)."""
        proposer, target = self.state.proposer, self.target_tokens
        assert proposer is not None
        with timed(self.times, "train"):
            made = proposer.propose(search.stretched(z), target, search.mean, search.std, rng)
        x = search.place_proposals(made, z)
        return x, search.near(x)

    @one_at_a_time
    @one_thread
    def tell(
        self,
        X: object,
        images: object = None,
        losses: object = None,
        *,
        features: object = None,
        version: str | None = None,
    ) -> Float64:
        """Report results, in any order and any number of pieces; returns their losses (n,).

        Parameters
        ----------
        X
            (n, dim), points in [0, 1]: those that were asked, or any others.
        images
            (n, H, W, C) or a list of n images, of the target's size, or of n tuples (image,
            coverage), coverage (H, W) in [0, 1], see `background` of `fide_plugins.options`; for a
            list of targets a list of these, one for each view; None: only losses are known, and
            the proposer does not learn from these points.
        losses
            (n,), the lower the better; None: the optimizer's own loss of the images.
        features
            (n, T, C), in place of the images: their tokens by the optimizer's encoder, computed
            elsewhere; losses must then be given.
        version
            of the encoder that made the features, which must be the optimizer's; None: you vouch.

        Points that were never asked (a warm start, a guess) are welcome: the proposer learns from
        them, they can become `best`, and the best of those told during a generation of a search (or
        before one) is injected: it takes the place of the worst candidate if it is better than
        that, its step cut to what a sample's may be.  A point that was asked may come back in
        single precision.

        Losses that are NaN or infinite rank last and are counted in `not_finite`.

        Raises
        ------
        PointsError, ImageError, LossError, FeaturesError
            all ValueErrors, before anything changes; of images also a ValueRangeError, if those
            told so far are on another scale than the target.
        """
        points = as_points(X, self.dim)
        n, evaluator = len(points), self.evaluator
        clipping = self.state.clipping.copy()
        batch = evaluator.as_batch(n, images, losses, features, clipping)
        with timed(self.times, "encode"):
            encode = self.state.proposer is not None
            results = evaluator.evaluate(n, batch, losses, features, version=version, encode=encode)
        self.state.clipping = clipping
        self.same_images.note(points, batch, results.losses)
        if self.state.kept is not None and batch is not None:
            at, given = self.state.evaluations, losses is not None
            self.state.kept.note(points, batch, results.losses, at, given=given)
        with timed(self.times, "search"):
            self._enter(results.of(points))
            adapt_light(self)
        return results.losses

    def _enter(self, results: Iterator[Result]) -> None:
        """Enter results; each generation that becomes complete is finished."""
        for result in results:
            self.state.record(*result)
            if self.state.population.complete:
                try:
                    self._finish_generation()
                except BaseException:  # of training; all else goes on as if it had trained
                    self._enter(results)
                    raise

    def _finish_generation(self) -> None:
        """Train (line 8) and update the search distribution (line 10)."""
        state = self.state
        members, losses = state.population.close_generation()
        samples = state.take_samples()
        if state.stage is not Stage.SEARCH:
            state.finish_stage(members, losses, samples)
            return
        try:
            with timed(self.times, "train"):
                self._train(samples)  # line 8
        finally:  # a generation that taught nothing is not lost
            self._update_search(members, losses)  # line 10

    def _train(self, samples: list[TrainingSample]) -> None:
        """Line 8: the proposer learns from what was evaluated since the last time."""
        state = self.state
        learned, state.learned = state.learned, []
        if state.proposer is None or not (samples or learned):
            return
        if learned:  # the gate judges the generation as a whole
            self._note_images(in_order(samples + learned))
        if samples:
            x, tokens, losses = columns(samples)  # (n, d), (n, T, C), (n,)
            if not learned:
                state.gate.note_images(tokens, self.target_tokens, losses)
            state.proposer.update(x, tokens, losses, state.search.std)

    def _note_images(self, samples: list[TrainingSample]) -> None:
        """Let the gate judge samples.  Their stacked tokens are gone when it has."""
        if self.state.gate.guarded:
            _, tokens, losses = columns(samples)
            self.state.gate.note_images(tokens, self.target_tokens, losses)

    def _update_search(self, members: list[Candidate], losses: Float64) -> None:
        """Line 10."""
        state = self.state
        state.gate.note_ranks(losses, np.array([candidate.proposed for candidate in members]))
        state.search.tell(members, losses, state.take_injected())
        state.note_mean()
        if state.steps is not None:
            state.steps.after_generation()
        over, guided = self._decision
        if guided is None:
            guided = state.gate.guided
        if over is None:
            over = self.options.restarts != "none" and state.search.is_over(guided=guided)
        if over:
            state.finish_search(guided=self.options.restarts == "moves" and guided)

    @contextmanager
    def decided(self, *, over: bool | None, guided: bool | None) -> Iterator[None]:
        """Within it, others have decided what follows a generation (`distributed`).

        over: whether the present search is over.  guided: whether images say where the next one
        begins.  None: the optimizer decides.
        """
        self._decision = over, guided
        try:
            yield
        finally:
            self._decision = None, None

    def recommend(self) -> Float64:
        """Mean (dim,) of the search distribution that found the best point (line 12).

        The best point itself if no search found it: a sensitivity sample, a restart candidate, a
        point that was never asked; also where the mean violates a constraint.
        """
        best = self.state.best
        mean = self.state.search.mean if best is None else best.mean
        recommended: Float64 = self.state.search.render_mean(mean)
        validity = self.validity
        if best is None or validity is None or validity.allows(recommended):
            return recommended
        return best.solution.x.copy()

    # -- saving ------------------------------------------------------------------------------------

    @one_at_a_time
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` gave `state`; ValueError if it is none, and nothing changes."""
        super().load_state_dict(state)
        self._propose_with(self.state.population, self.state.rng)
