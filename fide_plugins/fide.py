"""FIDE: feature-informed diffusion evolution, Algorithm 1 of the paper, by ask and tell.

Comments name its lines.  All that changes while an optimizer runs is its `state`; steps between the
generations and moves after a search (`State.finish_search`) are beyond Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from torch import Tensor

from fide_plugins.comparison.kept import Kept
from fide_plugins.comparison.scale_space import ScaleSpace
from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.evaluation import Evaluation, Evaluator, loss_of
from fide_plugins.options import Options, make_options
from fide_plugins.population import (
    BY_INDEX,
    CandidateRole,
    Memory,
    Population,
    columns,
)
from fide_plugins.proposers import make_proposer, make_step_model
from fide_plugins.proposers.image_gate import ImageGate
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.registry import own_name
from fide_plugins.runtime.schema import array, check, each, maybe, whole
from fide_plugins.runtime.threads import Lock, one_at_a_time, one_thread, timed
from fide_plugins.saving import Saved
from fide_plugins.search.cma_es import default_popsize
from fide_plugins.search.mixed import Axes
from fide_plugins.search.moves import Stage
from fide_plugins.search.one_search import Search, Setting
from fide_plugins.search.policy import MovePolicy
from fide_plugins.search.scene import APART
from fide_plugins.space import Space
from fide_plugins.space.constraints import constraints_not_stored
from fide_plugins.state import FOLLOWED, State
from fide_plugins.types import Float64, Posterior, Solution
from fide_plugins.validation.points import (
    as_points,
    new_seed,
    number_of_parameters,
    standard_deviations,
    starting_point,
    whole_number,
)
from fide_plugins.views import Views
from fide_plugins.views.findings import PixelNoise, SameImages

if TYPE_CHECKING:
    from fide_plugins.learning.model import Model
    from fide_plugins.search.validity import Validity
    from fide_plugins.status import Status

__all__ = ["FIDE", "Decision"]

_ARGUMENTS = ("dim", "weights", "value_range", "x0", "sigma0", "seed")
_ROUGHLY = 0.1  # standard deviation of a guess from which descents begin, at most
_COARSEST = 16  # pixels: smaller pictures are not blurred

Decision: TypeAlias = tuple[bool | None, bool | None]
"""Whether a search is over, and whether images say where the next begins, as others have decided.

None: the optimizer decides (`fide_adapters.optuna.replica`).
"""


class FIDE(Saved):
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
        views a list of them, None for a view without, or one for all; both: their product.
    value_range
        two numbers, the values of target and renders that are black and white, or "auto";
        None: 0 and 1, for uint8 0 and 255.
    popsize
        candidates a generation, at least 4; None: the preset's own.
    x0
        (dim,), a guess, with a `Space` also a dictionary of values: it is asked first, and the
        first search begins around it.  None: that begins around 0.5, which is not asked.
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
        are rendered first, after x0, and the best are where the first searches begin.
    constraints
        function of the parameters (a dictionary with a `Space`, else x of shape (dim,)) that
        returns True where they are valid, or margins: a number or several, <= 0 where they are.
        `ask` gives valid points only; the space's own `constraints` are respected, too.
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
        name = encoder if isinstance(encoder, str | None) else own_name(encoder)
        self.options = o = make_options(preset, {"encoder": name, "popsize": popsize, **options})
        self.x0 = starting_point(x0, self.dim, self.space)
        self.guess = None if x0 is None else self.x0
        self.sigma0, self.seed = standard_deviations(sigma0, self.dim), new_seed(seed)
        self.popsize = o.popsize or default_popsize(self.dim)
        self.axes = Axes(self.dim, None if self.space is None else self.space.layout)
        self.validity: Validity | None = None
        if constraints is not None or (self.space is not None and self.space.constraints):
            from fide_plugins.search.validity import validity_of

            self.validity = validity_of(self.space, constraints, self.seed, self.guess, self.axes)
        self.has_own_constraints = constraints is not None
        self.evaluator = Evaluator(
            target,
            loss,
            o.encoder if encoder is None else encoder,
            mask=mask,
            weights=weights,
            value_range=value_range,
            device=device,
            options=o,
        )
        self.same_images, self._lock = SameImages(self.popsize), Lock()
        model, posterior = (None, None) if learned is None else self._model_of(learned, self.views)
        self._model = model  # of the renderer, for the next picture, too; never saved
        self.state = self._initial_state(posterior)

    # -- line 1: mu and Sigma; line 2: the denoiser ------------------------------------------------

    def _initial_state(self, posterior: Posterior | None = None) -> State:
        """Lines 1 and 2; posterior: of a learned model, where the search begins."""
        o, k, learned = self.options, self.popsize, posterior is not None
        views, encoder = self.evaluator.views, self.evaluator.encoder
        subsets = o.channel_subsets or encoder.channel_subsets
        setting = Setting(k, np.broadcast_to(self.sigma0, self.dim), o, self.axes, self.validity)
        groups: Sequence[Sequence[int]] | None = o.groups
        if groups is None and self.space is not None:
            groups = self.space.largest_family or None  # if there is none, they are tested for
        follows = o.proposer in ("both", "linear") and o.restarts == "moves"
        guessed = self.guess is not None and bool(np.max(self.sigma0) <= _ROUGHLY)
        moves = MovePolicy(
            self.x0, setting.sigma0, popsize=k, target=self.evaluator.target_tokens,
            channels=subsets[0], seed=self.seed, groups=groups, axes=self.axes, posterior=posterior,
            descends=o.photo and follows and (learned or guessed),
        )  # fmt: skip
        if self.validity is not None:
            moves.start = replace(moves.start, mean=self.validity.start(moves.start.mean, 1))
        side = min(min(view.size) for view in views.views)
        may_blur = follows and o.coarse_to_fine is not False and bool(self.evaluator.loss.spec)
        scales = ScaleSpace(
            views,
            possible=may_blur and side >= _COARSEST and not (learned or moves.descends),
            at_once=bool(o.coarse_to_fine),
            photo=o.photo,
        )
        if moves.descends and not learned:
            rng = np.random.default_rng((self.seed, 2))
            moves.begin_around(self.x0, setting.sigma0, rng, np.empty((0, self.dim)))
        if moves.stage is Stage.DESCENT and moves.descents is not None:
            scales.begin_at(moves.descents.share)
        moves.start = scales.patient(moves.start)
        return State(
            rng=np.random.default_rng(self.seed),
            population=Population(),
            search=Search(moves.start, moves.goal, setting),
            moves=moves,
            gate=ImageGate(o, subsets, known=learned),
            proposer=make_proposer(o, self.dim, k, self.seed, encoder, learned=learned),
            steps=make_step_model(o, self.dim, k, encoder, learned=learned),
            memory=Memory(o.memory_mb),
            pixel_noise=PixelNoise(views),
            scales=scales,
            kept=None if self.evaluator.comparison is None else Kept(self.dim),
        )

    # -- ask: lines 4 and 5 ------------------------------------------------------------------------

    @one_at_a_time
    @one_thread
    def ask(self, n: int | None = None) -> Float64:
        """Candidates to render, float64 (n, dim) in [0, 1].

        None: what is left of the present generation, or, if all of it is pending, as many again,
        for users with more workers than that.  As soon as what is pending will complete the
        generation, candidates are drawn for the next one (`State.preview_search`).
        Who asks for a number may get Gauss-Newton steps before a generation (`proposers.forward`).
        """
        state, population = self.state, self.state.population
        n = None if n is None else whole_number("n", n, 1)
        with timed(state.times, "search"):
            steps = np.empty((0, self.dim)) if n is None else self.make_steps(n, state.rng)
            if not population.remaining and (n is None or n > len(steps)):
                self.draw_generation()
            rest = population.remaining if n is None else n - len(steps)
            if rest > len(population.queue):
                self._learn_before_proposing()
            if rest:
                self._make_next(rest)  # which may fail, before anything is handed out
            X = np.empty((rest, self.dim))
            for i in range(rest):
                if not population.remaining:
                    self.draw_generation()
                    self._make_next(rest - i)
                X[i] = population.hand_out().x
            if len(steps):
                self.hand_out_steps(steps)  # last: asking for the rest may fail
            return np.concatenate([steps, X])

    def _learn_before_proposing(self) -> None:
        """Line 8, within a generation: a lazy proposer learns what was told before it is asked."""
        state, proposer = self.state, self.state.proposer
        if proposer is None or not (proposer.lazy and self.state.samples):
            return
        if len(state.population.reserved):
            samples, state.samples = sorted(state.samples, key=BY_INDEX), []
            state.learned += samples
            with timed(state.times, "train"):
                proposer.update(*columns(samples), state.search.std)

    @one_at_a_time
    @one_thread
    def ask_ready(self) -> Float64:
        """As `ask`, but between two generations one step alone: the next one knows its result."""
        with timed(self.state.times, "search"):
            if len(step := self.make_steps(1, self.state.rng)):
                self.hand_out_steps(step)
                return step
        return self.ask()

    def draw_generation(self, first: Float64 | None = None) -> None:
        """Queue a generation; spare candidates where the present one needs exactly its own.

        first: (m, d), points that are asked first.  None: the user's guess, before all else.
        """
        state, population = self.state, self.state.population
        searching = state.moves.stage is Stage.SEARCH
        begins = not population.size and state.moves.stage is not Stage.DESCENT  # around the guess
        if first is None and begins and self.guess is not None:
            first = self.guess[None]
        begun = population.pending or population.told or population.withdrawn
        if state.generation_is_fixed and begun:
            # as many as it has, or, if nothing is pending, as many as it lacks
            n = population.size if population.pending else max(1, population.missing)
            x, _ = state.search.sample(n, state.rng)
            population.draw(x, x, spare=True)
        elif first is None or searching:
            self.draw(population, state.rng)
        else:  # hypotheses of a model, which all are asked, too
            x = np.concatenate([self.axes.clipped(first), state.draw_moves(state.rng)])
            population.draw(x, x)
        if state.steps is not None:
            state.steps.due, state.steps.remaining = False, 0  # they come before it, not in it
        if state.proposer is not None and not state.proposer.lazy:
            self.make_proposals(population, state.rng)
        if first is not None and searching:  # in the place of its first samples
            x = self.axes.clipped(first)[: population.remaining]
            population.replace(0, x, state.search.closest(x), proposed=np.zeros(len(x), bool))

    def draw(self, population: Population, rng: np.random.Generator) -> None:
        """Line 4: draw a generation, by `rng`, into a population, its own or another's.

        The last samples of a search are reserved for the proposer, if it is ready.
        """
        state = self.state
        if state.moves.stage is not Stage.SEARCH:
            x = state.draw_moves(rng)
            population.draw(x, x)
            return
        k = state.search.popsize
        x, z = state.search.sample(k, rng)  # (k, d), z ~ N(m, Sigma)
        ready = state.proposer is not None and state.proposer.ready
        n = k - state.gate.number(k, rng) if ready else k
        population.draw(x[:n], z[:n], z[n:], pair=state.search.distribution.draws_pair)

    def make_proposals(
        self, population: Population, rng: np.random.Generator, n: int | None = None
    ) -> None:
        """Line 5: denoise what a population has reserved, until n candidates are queued; None: all.

        Of a proposer that is not `lazy`, all of them at once.  If that raises, the next call tries
        again.  rng: of the proposer.
        """
        m, proposer = len(population.reserved), self.state.proposer
        if proposer is None or not m or (n is not None and n <= len(population.queue)):
            return
        if n is not None and proposer.lazy:
            m = n - len(population.queue)
        population.add_proposals(*self._propose(population.reserved[:m], self.state.search, rng))

    def _propose(
        self, z: Float64, search: Search, rng: np.random.Generator
    ) -> tuple[Float64, Float64]:
        """Proposals x and their z, (m, d) each, from samples of N(m, Sigma)."""
        proposer, target = self.state.proposer, self.evaluator.tokens_at(self.state.scales.blur)
        assert proposer is not None
        with timed(self.state.times, "train"):
            made = proposer.propose(search.stretched(z), target, search.mean, search.std, rng)
        x = search.place_proposals(made, z)
        return x, search.closest(x)

    def _make_next(self, n: int) -> None:
        """Make the next n candidates of those that remain, each for the generation that needs it.

        What the present one does not need any more is drawn again, for the next one, as many of
        them proposals as before.
        """
        state, population = self.state, self.state.population
        needed = max(0, population.size - len(population.told) - population.awaited)
        m = min(n, population.remaining) - needed
        if m > 0 and (state.proposer is None or state.proposer.lazy):
            search = state.preview_search()
            if search is not None:
                self.make_proposals(population, state.rng, needed)
                x, z = search.sample(m, state.rng)  # (m, d)
                made = [one.proposed for one in population.queue]
                made += [True] * len(population.reserved)
                proposed = np.array(made[needed : needed + m], bool)
                if proposed.any():
                    x[proposed], z[proposed] = self._propose(z[proposed], search, state.rng)
                population.replace(needed, x, z, proposed)
        self.make_proposals(population, state.rng, n)

    def make_steps(self, n: int, rng: np.random.Generator) -> Float64:
        """Steps (m, dim) that come before the next generation, at most n, by `rng`."""
        state, search, steps = self.state, self.state.search, self.state.steps
        none = np.empty((0, self.dim))
        between = state.moves.stage is Stage.SEARCH and not state.population.remaining
        if steps is None or not between or not state.gate.strength > 0:
            return none
        with timed(self.state.times, "train"):
            target = self.evaluator.tokens_at(self.state.scales.blur)
            left = steps.left(search.popsize, target, search.std)
            if not left:
                return none
            _, z = search.sample(min(n, left), rng)
            v = search.stretched(z)
            x = steps.propose(v, target, search.mean, search.std, rng)
        return steps.new_ones(search.place_proposals(x, z), state.population.is_pending)

    def hand_out_steps(self, x: Float64) -> None:
        """Count steps x (m, dim) as asked."""
        state = self.state
        assert state.steps is not None
        state.steps.remaining = max(0, state.steps.remaining - len(x))
        for row in zip(x, state.search.closest(x), strict=True):
            state.population.adopt(*row, CandidateRole.STEP)

    @one_at_a_time
    def withdraw(self, X: object) -> None:
        """Say that nobody waits for candidates X (n, dim) that were asked; raises PointsError."""
        for x in as_points(X, self.dim):
            self.state.population.withdraw(x)

    # -- tell: lines 7 to 10 -----------------------------------------------------------------------

    @one_at_a_time
    @one_thread
    def tell(
        self,
        X: object,
        images: object = None,
        losses: object = None,
    ) -> Float64:
        """Report results, in any order and any number of pieces; returns their losses (n,).

        Parameters
        ----------
        X
            (n, dim), points in [0, 1]: those that were asked, or any others.
        images
            (n, H, W, C) or a list of n images, of the target's size, or of n tuples (image,
            coverage), coverage (H, W) in [0, 1]; for a list of targets a list of these, one for
            each view; None: only losses are known, and the proposer does not learn from them.
        losses
            (n,), the lower the better; None: the optimizer's own loss of the images.  Those that
            are NaN or infinite rank last and are counted in `not_finite`.

        Points that were never asked (a warm start, a guess) are welcome: the proposer learns from
        them, they can become `best`, and the best of those told during a generation takes the place
        of its worst candidate if it is better, its step cut to what a sample's may be.  A point
        that was asked may come back in single precision.

        Raises
        ------
        PointsError, ImageError, LossError
            all ValueErrors, before anything changes; of images also a ValueRangeError, if those
            told so far are on another scale than the target.
        """
        points = as_points(X, self.dim)
        n, evaluator, given = len(points), self.evaluator, losses is not None
        clipping = replace(self.state.clipping)  # a copy: the rest may fail
        batch = evaluator.as_batch(n, images, losses, clipping)
        with timed(self.state.times, "encode"):  # lines 7 and 9
            encode = self.state.proposer is not None and (given or not self.state.scales.blur)
            note = self.state.needs_floor
            results = evaluator.evaluate(n, batch, losses, encode=encode, note=note)
        self.state.clipping = clipping
        if given and np.isfinite(results.losses).any():  # of a user: not at any blur
            self.state.stay_sharp()
        kept = self.state.kept
        if kept is not None and batch is not None:
            kept.note(points, batch, results.losses, self.evaluations, given=given)
        self.enter(points, results)
        if kept is not None:
            from fide_plugins.adapt_comparison import adapt_light

            adapt_light(self)
        return results.losses

    @one_at_a_time
    @one_thread
    def enter(
        self, points: Float64, results: Evaluation, decision: Decision = (None, None)
    ) -> None:
        """Enter results of points (n, dim), and finish generations, as `decision` says."""
        self.same_images.note(points, results.images, results.losses)
        state, entered, failure = self.state, 0, None
        with timed(self.state.times, "search"):
            while entered < len(points):
                blur = state.scales.blur
                encode = state.proposer is not None
                results = self.evaluator.at_blur(results, blur, encode=encode)
                for result in results.of(points, entered):
                    state.record(*result)
                    entered += 1
                    if state.population.complete:
                        try:
                            self._finish_generation(decision)
                        except BaseException as error:  # of training; as if it had trained
                            failure = error
                    if state.scales.blur != blur:
                        break
        if failure is not None:
            raise failure

    def _finish_generation(self, decision: Decision) -> None:
        """Train (line 8) and update the search distribution (line 10)."""
        state = self.state
        members, losses = state.population.close_generation()
        samples, state.samples = sorted(state.samples, key=BY_INDEX), []
        target = self.evaluator.tokens_at(state.scales.blur)
        if state.kept is not None and self.evaluator.comparison is not None:
            state.tell_hypotheses(state.kept, self.evaluator.comparison)
        if state.moves.stage is not Stage.SEARCH:
            state.finish_stage(members, losses, samples, target)
            return
        (learned, state.learned), proposer = (state.learned, []), state.proposer
        try:
            with timed(state.times, "train"):  # line 8
                guarded = samples or state.gate.guarded  # which judges the generation as a whole
                if proposer is not None and guarded and (samples or learned):
                    _, tokens, told = columns(sorted(samples + learned, key=BY_INDEX))
                    state.gate.note_images(tokens, target, told)
                    del tokens
                if proposer is not None and samples:
                    proposer.update(*columns(samples), state.search.std)
        finally:  # a generation that taught nothing is not lost
            state.update_search(members, losses)  # line 10
            over, guided = decision  # go on with the search, or elsewhere where it is over
            guided = state.gate.guided if guided is None else guided
            if state.begin_coarse(self.evaluator.target):
                over = False
            elif over is None:
                over = self.options.restarts != "none" and state.is_over(guided=guided)
            if over:
                state.finish_search(guided=self.options.restarts == "moves" and guided)

    def recommend(self) -> Float64:
        """Mean (dim,) of the search distribution that found the best point (line 12).

        The best point itself if no search found it, or where the mean violates a constraint.
        """
        best = self.state.best
        mean = self.state.search.mean if best is None else best.mean
        recommended: Float64 = self.axes.reflected(mean[None])[0]
        if best is None or self.validity is None or self.validity.allows(recommended):
            return recommended
        return best.solution.x.copy()

    # -- what is known -----------------------------------------------------------------------------

    @property
    @one_at_a_time  # an estimate reads what another thread may be training
    def best(self) -> Solution | None:
        """Best point told so far; None before the first with a finite loss.

        Its `params` are named where the optimizer was made with a `Space`; its `std` is by what is
        known now, and computed when it is read (`fide_plugins.uncertainty`).
        """
        best = self.state.best
        if best is None:
            return None
        image = self.views.restored(self.views.unpacked(best.solution.image))
        seen = self.best_image
        light = None
        if self.state.kept is not None and seen is not None:
            light = self.evaluator.light_of(seen)
        estimate = self.state.estimate_of(best.solution.x)
        found = replace(best.solution, image=image, space=self.space, estimate=estimate)
        return replace(found, photometric=light).copy()

    @property
    def best_image(self) -> Any:
        """Image (H, W, C) of the best point, with its coverage where that is known, or None."""
        best, kept = self.state.best, self.state.kept
        if best is None or best.solution.image is None:
            return None
        return best.solution.image if kept is None else kept.image_of(best.solution)

    @one_at_a_time
    def adjust(self, images: object) -> Any:
        """Images as they are compared with the target: in its light, at the present blur, robust.

        images: as `tell` takes them.  Returns (n, H, W, 3), for a list of targets a list of these;
        values may leave [0, 1], or the range of values.  Raises ImageError.
        """
        return self.evaluator.adjusted(images)

    @property
    @one_at_a_time
    def residual(self) -> Any:
        """What is left, (H, W) in [0, 1], a list for a list of targets; None without an image.

        Absolute difference of target and best image, in the light of the target where that is
        adjusted: mean of the channels, 0 where a mask has zeros or the image covers nothing.
        """
        image = self.best_image
        if image is None:
            return None
        left = self.evaluator.residual(image)
        return left if self.views.listed else left[0]

    @property
    @one_at_a_time
    def status(self) -> Status:
        """What is known of the run so far: a code, and a sentence (see `fide_plugins.status`)."""
        from fide_plugins.status import status_now
        from fide_plugins.views.findings import is_solved

        image = None if self.state.best is None else self.state.best.solution.image
        return status_now(self, solved=image is not None and is_solved(self.views, image))

    @one_at_a_time
    def solutions(self, k: int = 5) -> list[Solution]:
        """Up to k distinct candidates, best first: where searches have ended.

        Exchangeable blocks are matched first, so that no order of the same things counts twice.
        Each has its own `std`.  `probability` is that among those found, by a learned model and by
        their losses (`search.hypotheses`); None where no model knows the picture.

        Raises OptionError (a ValueError) unless k is a whole number of at least 1.
        """
        k = whole_number("k", k, 1)
        best, known = self.best, self.state.moves.known
        found = [] if best is None else [best]
        for sample in (optimum.sample for optimum in known.optima.all):
            distances = [known.exchangeability.distance(sample.x, one.x, APART) for one in found]
            if min(distances, default=np.inf) >= APART:
                one = Solution(sample.x.copy(), sample.loss, sample.evaluation)
                estimate = self.state.estimate_of(sample.x)
                found.append(replace(one, space=self.space, estimate=estimate))
        points = np.array([one.x for one in found]).reshape(len(found), self.dim)
        hypotheses = self.state.moves.hypotheses
        if found and hypotheses is not None and hypotheses.available:
            from fide_plugins.search.hypotheses import probabilities

            losses, noise = [one.loss for one in found], self.state.moves.noise
            alike = known.exchangeability, known.axes
            p = probabilities(losses, points, hypotheses.x, hypotheses.typical, noise, *alike)
            found = [replace(one, probability=x) for one, x in zip(found, p.tolist(), strict=True)]
        return found[:k]

    @property
    def evaluations(self) -> int:
        """Points told so far, and renders of the same run that were learned from before."""
        return self.state.evaluations

    @property
    def not_finite(self) -> int:
        """Points told so far whose loss was NaN or infinite."""
        return self.state.not_finite

    @property
    def times(self) -> dict[str, float]:
        """Seconds spent so far in "encode" (features and losses), "train" and "search"."""
        return self.state.times

    @property
    def target(self) -> Any:
        """Target (H, W, 3), or a list of them, one for each view, in the values of the user."""
        return self.views.restored(self.evaluator.full.targets)

    @property
    def encoder(self) -> PatchEncoder:
        """What makes tokens of images."""
        return self.evaluator.encoder

    @property
    def target_tokens(self) -> Tensor:
        """Tokens (T, C) of the target."""
        return self.evaluator.target_tokens

    @property
    def views(self) -> Views:
        """Targets and weights of the views; one view for a single target."""
        return self.evaluator.views

    @property
    def weights(self) -> Any:
        """Which pixels count, mask times weights: (H, W), None for all; a list for a list."""
        return self.views.weights

    @property
    def value_range(self) -> tuple[float, float] | None:
        """Values of target and renders that are black and white; None: 0 and 1."""
        return self.views.value_range

    @property
    def clipped(self) -> int:
        """Images told so far whose values went beyond black or white, and were clipped."""
        return self.state.clipping.images

    # -- where searches begin, and the next picture ------------------------------------------------

    def _model_of(self, learned: Any, views: Views) -> tuple[Model | None, Posterior | None]:
        """A learned model, or that of a file, and what it says of the targets of views."""
        from fide_plugins.learning.posterior import as_model, posterior_of

        model = as_model(learned)
        if model is not None and self.options.photo and model.report.clutter is None:
            warn_user(
                f"photo=True is for photographs, and the model of {model.renderer!r} has learned "
                "renders without clutter: learn one with backgrounds or clutter=True"
            )
        return model, posterior_of(model, self.space or self.dim, views.targets, self.seed)

    def random_point(self, number: int) -> Float64:
        """Random point (dim,) that may be rendered; the same for the same number, from 0."""
        rng = np.random.default_rng((self.seed, 3, number))
        x: Float64 = self.axes.clipped(rng.random((1, self.dim)))[0]
        return x if self.validity is None else self.validity.start(x, number + 2)

    @one_at_a_time
    def begin_at(self, x: Float64) -> None:
        """Begin the first search at x (d,), which may have been told; candidates are forgotten.

        Where something else comes first, such as hypotheses of a learned model, nothing happens.
        """
        state = self.state
        if state.moves.stage is Stage.SEARCH and not state.population.generations:
            state.begin_at(x)

    @one_at_a_time
    @one_thread
    def retarget(
        self,
        picture: object,
        *,
        loss: str | Callable[..., object] | None = None,
        learned: Any = None,
    ) -> None:
        """Find the parameters of the next picture, with what was learned from earlier ones.

        Parameters
        ----------
        picture
            as `target` of the constructor, of the same size; the range of values stays that of the
            first one, also if that was "auto".
        loss
            None keeps a loss that was given by its name.  A callable, which may know the old
            picture only, must be given again.
        learned
            model of the renderer, or its file, as `learned` of the constructor.  None keeps that
            model, which is not saved: after `load` there is none.

        The search begins at the candidate whose image, of all that are remembered, is nearest to
        the picture, as wide as parameters have to move for it (`search.recall`).  This candidate is
        asked first; where nothing is remembered, the best point so far.  Proposers know the
        remembered images from the first generation on.  `best`, `solutions`, `status` and the local
        optima begin again; `evaluations` goes on, and what is known of the scene stays.  Candidates
        that are still out may be told, with images or with the loss to the new picture.

        With a model its hypotheses are rendered after the remembered candidates, unless these say
        more exactly than the model where the parameters are; there are no steps then.

        With `photo=True`, after a run that began with descents (with a model or near a guess), the
        next begins with descents from around the last answer and from hypotheses.

        Raises ImageError, LossError, UnknownNameError or OptionError (ValueErrors), OSError or
        CheckpointError for a file that is no model, before anything changes.
        """
        evaluator = self.evaluator.retargeted(picture, loss)
        learned = self._model if learned is None else learned
        views = evaluator.views
        model, posterior = (None, None) if learned is None else self._model_of(learned, views)
        state = self.state
        with timed(self.state.times, "search"):
            recalled = state.recall(evaluator.target_tokens, self.guess, self.popsize)
            known, last = bool(recalled.samples), None
            if state.moves.descends and (state.best is not None or posterior is None):
                last = self.guess if state.best is None else state.best.solution.x
            apart = self.sigma0 if state.best is None else FOLLOWED
            guesses = np.empty((0, self.dim)) if posterior is None else posterior.x
            if posterior is not None and (
                last is not None or (known and state.moves.is_wider(posterior, recalled.start))
            ):
                posterior = None  # the memory says more exactly where the answer is
            self.evaluator, self._model = evaluator, model
            if state.kept is not None:
                state.kept = Kept(self.dim)  # the old were of another picture
            state.retarget(evaluator.target_tokens, recalled.start, posterior)
            if posterior is None:
                state.teach(recalled.samples, recalled.start.std, self.popsize)
            else:
                self._use_model_only()
            if last is not None:
                rng = np.random.default_rng((self.seed, 2, self.evaluations))
                state.follow(last, apart, guesses, rng)
            self.draw_generation(recalled.hypotheses if last is None else None)

    def _use_model_only(self) -> None:
        """Go on as a run that began with a model: proposers forget what was before."""
        state = self.state
        state.gate.note_known()
        state.steps = None
        if self.options.proposer != "diffusion":  # which keeps its weights
            o, k = self.options, self.popsize
            state.proposer = make_proposer(o, self.dim, k, self.seed, self.encoder, learned=True)

    # -- saving ------------------------------------------------------------------------------------

    @property
    def pretrained(self) -> tuple[str, str] | None:
        """Name of the encoder and digest of its pretrained weights; None if it has none."""
        digest = self.encoder.weights_digest
        return None if digest is None else (self.options.encoder, digest)

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, but for `loss` and `device`; the target is in [0, 1]."""
        given = {name: getattr(self, name) for name in _ARGUMENTS}
        given |= {"target": self.evaluator.full.targets, "x0": self.guess}
        space = None if self.space is None else self.space.to_dict()
        own = {"popsize": self.popsize, "space": space, "constraints": self.has_own_constraints}
        return given | asdict(self.options) | own

    @classmethod
    def arguments(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Arguments of the constructor, by name, of what `settings` gave."""
        given = dict(settings) | {"target": Views.from_settings(settings)}
        for name in ("weights", "value_range"):  # which the views have
            given.pop(name, None)
        space = given.pop("space")
        given["constraints"] = constraints_not_stored if given.get("constraints") else None
        return given if space is None else given | {"dim": Space.from_dict(space)}

    @classmethod
    def resolve_loss(cls, loss: Any, settings: Mapping[str, Any], device: str) -> Any:
        """The loss that a user gave, for an optimizer of these settings, on that device."""
        return loss_of(Views.from_settings(settings), loss, device=device)

    @property
    def loss_name(self) -> str | None:
        """Name by which the loss can be made again; None for a user's own."""
        return self.evaluator.loss.spec

    @one_at_a_time
    @one_thread
    def state_dict(self) -> dict[str, Any]:
        """The state, and the versions of encoder and loss."""
        comparison = self.evaluator.comparison
        how = None if comparison is None else comparison.state_dict()
        versions = self.evaluator.versions
        size = {} if self.evaluator.size is None else {"size": list(self.evaluator.size)}
        return {**self.state.state_dict(), "versions": versions, "comparison": how, **size}

    @one_at_a_time
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` gave `state`; ValueError if it is none, and nothing changes."""
        if not isinstance(state, Mapping) or not {"versions", "comparison"} <= set(state):
            raise ValueError("this is no state of FIDE: it lacks 'versions' or 'comparison'")
        state = dict(state)
        self.evaluator.check_versions(state.pop("versions"))
        before = self.evaluator
        size = state.pop("size", None)
        check(size, maybe(each(whole(1))), {}, "size")
        size = None if size is None else tuple(size)
        sized = before if size == before.size else before.at_size(size)
        self.evaluator = sized.comparing(state.pop("comparison"))
        try:
            fresh = self._initial_state()
            sides = dict(zip("HW", self.views.target.shape, strict=False), d=self.dim)
            sides |= dict(zip("TC", self.target_tokens.shape, strict=True))
            fresh.load_state_dict(state, {**sides, "device": self.encoder.device})
        except BaseException:
            self.evaluator = before
            raise
        self.state = fresh
        self.same_images.forget()

    @classmethod
    def check_settings(cls, settings: Mapping[str, Any]) -> None:
        """Raise ValueError unless all settings are there, and can be those of an optimizer."""
        super().check_settings(settings)
        own = {"target", "popsize", "space", "constraints"}
        expected = {*_ARGUMENTS, *own, *asdict(Options())}
        odd = sorted(set(settings) ^ expected)
        if odd:
            raise ValueError(f"settings lack or have too much: {', '.join(map(repr, odd))}")
        check(settings["x0"], maybe(array("d")), {"d": settings["dim"]}, "x0")
        Views.check_settings(settings)
