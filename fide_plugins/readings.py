"""What can be read of an optimizer at any time, and what a checkpoint holds of it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.evaluation import Evaluator
from fide_plugins.options import Options, flat
from fide_plugins.runtime.schema import array, check, maybe
from fide_plugins.runtime.threads import one_at_a_time, one_thread
from fide_plugins.saving import Saved
from fide_plugins.search.scene.optima import APART
from fide_plugins.search.validity import Validity
from fide_plugins.space import Space
from fide_plugins.space.constraints import constraints_not_stored
from fide_plugins.state import State
from fide_plugins.status import Facts, Status, status_of
from fide_plugins.types import Float32, Float64, Posterior, Solution
from fide_plugins.validation.points import whole_number
from fide_plugins.views import Views
from fide_plugins.views.loss import loss_of
from fide_plugins.views.same_images import SameImages
from fide_plugins.views.solved import is_solved

__all__ = ["Readings"]

_ARGUMENTS = ("dim", "weights", "value_range", "x0", "sigma0", "seed")
_STALLED = 20  # generations without improvement; or a quarter of all evaluations, if that is more


class Readings(Saved):
    """Readings of `state`: they change nothing."""

    dim: int
    popsize: int
    seed: int
    x0: Float64
    guess: Float64 | None
    """x0 where a user has given it."""
    sigma0: float | Float64
    options: Options
    space: Space | None
    evaluator: Evaluator
    state: State
    same_images: SameImages
    validity: Validity | None
    has_own_constraints: bool

    @property
    def target(self) -> Any:
        """Target (H, W, 3), or a list of them, one for each view, in the values of the user."""
        return self.views.restored(self.views.targets)

    @property
    def encoder(self) -> PatchEncoder:
        """What makes tokens of images."""
        return self.evaluator.encoder

    @property
    def pretrained(self) -> tuple[str, str] | None:
        """Name of the encoder and digest of its pretrained weights; None if it has none."""
        digest = self.encoder.weights_digest
        return None if digest is None else (self.options.encoder, digest)

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

    @property
    @one_at_a_time  # an estimate reads what another thread may be training
    def best(self) -> Solution | None:
        """Best point told so far; None before the first with a finite loss.

        Its `params` are named where the optimizer was made with a `Space`.  Its `std` is what is
        known now, and computed when it is read (`fide_plugins.uncertainty`): None where too few
        images near the point are remembered.
        """
        best = self.state.best
        if best is None:
            return None
        image = self.views.restored(self.views.unpacked(best.solution.image))
        estimate = self.state.estimate_of(best.solution.x)
        found = replace(best.solution, image=image, space=self.space, estimate=estimate)
        return replace(found.copy(), photometric=self._light_of(best.solution))

    def _light_of(self, solution: Solution) -> Any:
        """Light in which the image of a solution is compared, a list for a list of targets."""
        comparison = self.evaluator.comparison
        if comparison is None or solution.image is None:
            return None
        light = comparison.compare(self._with_coverage(solution)[None]).light
        return None if light is None else light[0] if self.views.listed else light[0][0]

    def _with_coverage(self, solution: Solution) -> Float32:
        """Image (H, W, 3) of a solution, with its coverage as fourth channel where it has one."""
        assert solution.image is not None
        kept = self.state.kept
        coverage = None if kept is None else kept.coverage_of(solution.x)
        if coverage is None:
            return solution.image
        return np.concatenate([solution.image, coverage], axis=-1)

    @one_at_a_time
    def adjust(self, images: object) -> Any:
        """Images as they are compared with the target: in its light, at the present blur, robust.

        images: as `tell` takes them.  Without `photometric`, `robust`, `background` and `photo`
        they stay as they are.

        Returns (n, H, W, 3), for a list of targets a list of these; values may leave [0, 1], or the
        range of values.  Raises ImageError.
        """
        return self.evaluator.adjusted(images)

    @property
    @one_at_a_time
    def residual(self) -> Any:
        """What is left, (H, W) in [0, 1], a list for a list of targets; None without an image.

        Absolute difference of the best image, in the light of the target, and the target: mean of
        the channels, 0 where a mask has zeros or where the image does not cover the target.
        """
        best = self.state.best
        if best is None or best.solution.image is None:
            return None
        left = self.evaluator.residual(self._with_coverage(best.solution))
        return left if self.views.listed else left[0]

    @property
    @one_at_a_time
    def status(self) -> Status:
        """What is known of the run so far: a code, and a sentence (see `fide_plugins.status`)."""
        state, best = self.state, self.state.best
        since = state.evaluations - state.retargeted_at
        known = state.moves.known
        others, apart = known.optima.others(known.exchangeability.distance)
        facts = Facts(
            evaluations=state.evaluations,
            best=None if best is None else best.solution.loss,
            improved_at=state.improved_at,
            horizon=max(_STALLED * state.search.popsize, since // 4),
            ended=state.moves.ended,
            forgotten=known.optima.forgotten,
            others=others,
            apart=apart,
            solved=self._is_solved(),
            grain=self._grain_left(),
            same=self.same_images.number,
            clipped=state.clipping.images,
            low=state.clipping.low,
            high=state.clipping.high,
        )
        return status_of(facts)

    def _grain_left(self) -> float | None:
        """Standard deviation of a pixel, if only noise keeps the best image from the target."""
        image = None if self.state.best is None else self.state.best.solution.image
        return None if image is None else self.state.grain.left(image, self.views.target)

    def _is_solved(self) -> bool:
        image = None if self.state.best is None else self.state.best.solution.image
        return image is not None and is_solved(self.views, image)

    @one_at_a_time
    def solutions(self, k: int = 5) -> list[Solution]:
        """Up to k distinct candidates, best first: where searches have ended.

        The later ones may be far worse than the best; a loss near its loss is as good an answer.
        Exchangeable blocks are matched first, so that no order of the same things counts twice.
        Each has its own `std`, as `best` has.
        `probability` is that among those found, by a learned model and by their losses (see
        `search.scene.modes`); None where no model knows the picture.

        Raises OptionError (a ValueError) unless k is a whole number of at least 1.
        """
        k = whole_number("k", k, 1)
        best, known = self.best, self.state.moves.known
        found = [] if best is None else [best]
        for sample in (optimum.sample for optimum in known.optima.all):
            distances = [known.exchangeability.distance(sample.x, one.x) for one in found]
            if min(distances, default=np.inf) >= APART:
                one = Solution(sample.x.copy(), sample.loss, sample.evaluation)
                estimate = self.state.estimate_of(sample.x)
                found.append(replace(one, space=self.space, estimate=estimate))
        points = np.array([one.x for one in found]).reshape(len(found), self.dim)
        probability = self.state.moves.probabilities([one.loss for one in found], points)
        if probability is not None:
            found = [
                replace(one, probability=p)
                for one, p in zip(found, probability.tolist(), strict=True)
            ]
        return found[:k]

    @one_at_a_time
    def elsewhere(self, solutions: Sequence[Solution]) -> float | None:
        """Share of a model's hypotheses that are far from all these solutions of this optimizer.

        Probabilities of `solutions` are relative to each other: one alone has 1.  A large share
        here says that the model takes other answers for possible, which no search has reached, or
        which were rendered and excluded.  None where no model knows the picture.
        """
        points = np.array([one.x for one in solutions]).reshape(len(solutions), self.dim)
        return self.state.moves.elsewhere(points)

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
    def features_shape(self) -> tuple[int, int]:
        """(T, C) of the features of an image, see `tell`."""
        return self.evaluator.features_shape

    @property
    def training(self) -> bool:
        """Whether the network learns in the background; saving and proposals would wait for it."""
        return self.state.proposer is not None and self.state.proposer.busy

    # -- saving: see `saving.Saved` ---------------------------------------------------------------

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`, as plain values.

        The target is in [0, 1], whatever the user's values are.
        """
        given = {name: getattr(self, name) for name in _ARGUMENTS}
        given |= {"target": self.views.targets, "x0": self.guess}
        space = None if self.space is None else self.space.to_dict()
        own = {"popsize": self.popsize, "space": space, "constraints": self.has_own_constraints}
        return given | flat(self.options) | own

    @classmethod
    def arguments(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Arguments of the constructor, by name, of what `settings` gave."""
        given = dict(settings) | {"target": Views.from_settings(settings)}
        for name in ("weights", "value_range"):  # which the views have
            given.pop(name, None)
        space = given.pop("space")
        given["constraints"] = constraints_not_stored if given.get("constraints") else None
        return given if space is None else given | {"dim": Space.from_dict(space)}

    def settings_there(self, settings: Mapping[str, Any]) -> Mapping[str, Any]:
        """Earlier versions lack constraints and a range, and stored an x0 that nobody gave."""
        if "constraints" in settings:
            return settings
        x0 = self.guess if np.array_equal(settings["x0"], self.x0) else settings["x0"]
        return {"constraints": False, "value_range": None, **settings, "x0": x0}

    @classmethod
    def resolve_loss(cls, loss: Any, settings: Mapping[str, Any], device: str) -> Any:
        """Loss that a user gave for an optimizer of these settings; raises as `loss_of`."""
        return loss_of(Views.from_settings(settings), loss, device=device)

    @property
    def loss_name(self) -> str | None:
        """Name by which the loss can be made again; None for a user's own."""
        return self.evaluator.loss_name

    @one_at_a_time
    @one_thread
    def state_dict(self) -> dict[str, Any]:
        """The state, and the versions of encoder and loss."""
        comparison = self.evaluator.comparison
        how = None if comparison is None else comparison.state_dict()
        versions = self.evaluator.versions
        return {**self.state.state_dict(), "versions": versions, "comparison": how}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` was called; ValueError if it is none, and nothing changes."""
        if not isinstance(state, Mapping) or "versions" not in state:
            raise ValueError("this is no state of FIDE: it lacks 'versions'")
        state = dict(state)
        self.evaluator.check_versions(state.pop("versions"))
        evaluator, self.evaluator = (
            self.evaluator,
            self.evaluator.comparing(state.pop("comparison", None)),
        )
        try:
            fresh = self._restored(state)
        except BaseException:
            self.evaluator = evaluator
            raise
        self.state = fresh
        self.same_images.forget()

    def _restored(self, state: Mapping[str, Any]) -> State:
        """State that `State.state_dict` gave."""
        (height, width, _), (tokens, channels) = self.views.target.shape, self.features_shape
        sides = {"d": self.dim, "H": height, "W": width, "T": tokens, "C": channels}
        fresh = self._initial_state()
        fresh.load_state_dict(state, sides, self.evaluator.encoder.device)
        return fresh

    @abstractmethod
    def _initial_state(self, posterior: Posterior | None = None) -> State:
        """Return a state in which nothing was asked; posterior: where it begins."""

    @classmethod
    def check_settings(cls, settings: Mapping[str, Any]) -> None:
        """Raise ValueError unless all settings are there, and can be those of an optimizer."""
        super().check_settings(settings)
        expected = {*_ARGUMENTS, "target", "popsize", "space", *flat(Options())}
        later = {"constraints", "value_range"}  # which earlier versions lack
        odd = sorted((set(settings) ^ expected) - later)
        if odd:
            raise ValueError(f"settings lack or have too much: {', '.join(map(repr, odd))}")
        check(settings["x0"], maybe(array("d")), {"d": settings["dim"]}, "x0")
        Views.check_settings(settings)
