"""What a search has of learning: hypotheses of a model, and rounds of learning before a search.

``preset="global"``: rounds of renders and learning for one hard picture, and then the search.

=========  ===================================================================================
renders    of what
=========  ===================================================================================
40 %       the whole space; a model learns them
30 %       the region where the model's posterior of the picture is; a second model learns all
30 %       the search (`preset="balanced"`), which begins at hypotheses of the second model
=========  ===================================================================================

A picture unlike all renders of the first round has no posterior to be trusted: there is no second
round, and the search gets its renders, too.  The files lie in the folder `rounds` of the run
directory, so an interrupted fit goes on where it was.  The renders are removed when the search
begins; the model of the first round, `first.fide`, stays for other pictures of the renderer.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time as clock
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import ModelNotFoundError, OptionError
from fide_plugins.options import GLOBAL
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.registry import changed, fingerprint_of, version_of
from fide_plugins.space import Space
from fide_plugins.types import Float64, Mask, Posterior

if TYPE_CHECKING:
    from fide_plugins.learning.model import Model
    from fide_plugins.learning.pipeline import LearnProgress

_DRAWN = 512
_DESCENTS = 16  # from hypotheses that were drawn, and as many from anywhere


def as_model(learned: Any) -> Model | None:
    """Return the model that `learned` is, or that its file has; None for None.

    Raises OSError or CheckpointError for a file that is no model, OptionError for anything else.
    """
    if learned is None:
        return None
    from fide_plugins.learning.model import Model  # takes a second: PyTorch's networks

    if isinstance(learned, str | os.PathLike):
        learned = Model.load(learned)
    if not isinstance(learned, Model):
        raise OptionError(f"learned is a model or its file, not {type(learned).__name__}")
    return learned


def posterior_of(
    learned: Model | None, space: Space | int, target: Any, seed: int
) -> Posterior | None:
    """Draw hypotheses of a target's parameters, and refine some where there is a good emulator.

    It is None without a model, and, with a warning, for a picture unlike all renders.  Warns of a
    model that a second round has made for another picture.

    target: (H, W, 3), or a list with it.  What a mask hides of it is seen, too.

    Raises OptionError for a model of another space or for several views, ImageError for another
    aspect.
    """
    if learned is None:
        return None
    learned.check_space(space)
    if isinstance(target, list):
        if len(target) > 1:
            raise OptionError(
                f"a learned model knows one picture of each scene, and the target has "
                f"{len(target)} views: leave out learned, or fit the view it was learned from alone"
            )
        target = target[0]
    far = learned.unfamiliarity(target)
    if far > 1:
        warn_user(f"{learned.unlike_all(far)}: the search goes on without the model")
        return None
    if learned.is_of_another(target):
        warn_user(
            f"the model of {learned.renderer!r} is one of a second round, for another picture: its "
            "hypotheses of this one are less exact; learn a second round for it, or take the model "
            "of the first"
        )
    x = learned.sample(target, _DRAWN, seed % 2**32)
    if learned.head == "set":
        x[0] = _middle(x, np.array(learned.periodic))
    refined = _refined(learned, target, x, seed % 2**32) if learned.emulates else None
    return Posterior(x, refined)


def _refined(model: Model, target: Any, x: Float64, seed: int) -> Float64:
    """What descents find (m, d) from hypotheses x (n, d) and from anywhere."""
    anywhere = np.random.default_rng((seed, 3)).random((_DESCENTS, model.dim))
    return model.refined(target, np.concatenate([x[:_DESCENTS], anywhere]), seed)


def _middle(x: Float64, periodic: Mask) -> Float64:
    """Middle (d,) of sets (n, d) whose blocks come in one order: more exact than any of them."""
    turn = np.mod(np.angle(np.exp(2j * np.pi * x).mean(axis=0)) / (2 * np.pi), 1.0)
    return np.asarray(np.where(periodic, turn, np.median(x, axis=0)), np.float64)


def model_for(learned: Any, render: object) -> Any:
    """Model of a file, or what else is given as `learned`, for a search of images by `render`.

    Warns if it is of another renderer, but where both state the same version.

    Raises OptionError where they state different versions, or `render` one that is no text; OSError
    or CheckpointError for a file that is no model.
    """
    if learned is None:
        return None
    from fide_plugins.learning.model import Model

    model = Model.load(learned) if isinstance(learned, str | os.PathLike) else learned
    if isinstance(model, Model):
        _check_renderer(model, render)
    return model


def with_model(options: Mapping[str, Any], render: object) -> dict[str, Any]:
    """Options with a model in place of its file, see `model_for`, which raises and warns."""
    if "learned" not in options:
        return dict(options)
    return {**options, "learned": model_for(options["learned"], render)}


def _check_renderer(model: Model, render: object) -> None:
    """Raise OptionError, or warn, unless the model is of this renderer."""
    here = version_of(render)
    if model.version is not None and here is not None:
        if model.version != here:
            raise OptionError(
                f"the model has learned version {model.version!r} of {model.renderer!r}, and the "
                f"renderer states version {here!r}: learn this version into another file, or leave "
                "out the model"
            )
    elif changed(model.fingerprint, fingerprint_of(render)):
        warn_user(
            f"the model has learned {model.renderer!r}, and that is not what renders here, or it "
            "was changed since; learn it again if its images are others now"
        )


LEAST = 10_000
"""Renders of the whole budget."""
_FIRST, _SECOND = 0.4, 0.3  # of the budget
_TIME = 0.5  # of a time limit, for both rounds
_SIZE = 64  # longer side of the renders, in pixels
_PASSES = 10  # over the renders of a round, at most
_SEARCH = "balanced"  # preset of the search
_DOING = {
    "train": "model, pass",
    "emulate": "emulator, pass",
    "calibrate": "model, calibrating",
    "judge": "model, judging",
}
"""Words for the stages of `LearnProgress` but for rendering."""


@dataclass(frozen=True)
class Learned:
    """What the rounds have learned.

    model: of the last round.  renders: of all rounds.
    """

    model: Model
    renders: int


@dataclass(frozen=True)
class Rounds:
    """Rounds for one picture; nothing is rendered before `learn`.

    render, space: arguments of `fide_plugins.learn`.
    picture: the target.
    budget: renders in all, the search included.
    folder: where files are kept; None: nowhere.
    seconds: of rendering and learning at most; None: no limit.
    device: where networks train.
    """

    render: Any
    space: Space | int | None
    picture: Any
    budget: int
    seed: int
    folder: Path | None
    seconds: float | None = None
    device: str = "auto"

    def learn(
        self, workers: int = 1, on_progress: Callable[[int, str], None] | None = None
    ) -> Learned:
        """Render and learn, or go on with it; raises as `fide_plugins.learn` does.

        workers: processes that render; 1 for a `render` that cannot be pickled.
        on_progress: called with the number of renders so far, and what is being done.
        """
        start = clock.monotonic()
        with ExitStack() as stack:
            folder = self.folder
            if folder is None:
                made = tempfile.TemporaryDirectory(prefix="fide-rounds-")
                folder = Path(stack.enter_context(made))
            folder.mkdir(parents=True, exist_ok=True)
            end = None if self.seconds is None else start + self.seconds
            middle = None if self.seconds is None else start + 0.5 * self.seconds
            learn = partial(self._learn, folder, workers, on_progress)
            # the second model gives the hypotheses, so the first needs no emulator
            first = learn("first", 0, self.renders[0], middle, emulator=False)
            seen = first.report.renders + first.report.held_out + first.report.failed
            if not first.knows(self.picture):
                return Learned(first, seen)
            second = learn(
                "second", self.renders[0], self.renders[1], end,
                after=folder / "first.fide", picture=self.picture,
            )  # fmt: skip
            report = second.report
            seen = report.renders + report.held_out + report.failed
            return Learned(second, seen + first.report.failed)

    def _learn(
        self,
        folder: Path,
        workers: int,
        on_progress: Callable[[int, str], None] | None,
        name: str,
        before: int,
        renders: int,
        end: float | None,
        **more: Any,
    ) -> Model:
        """One round, by the clock until `end`; before: renders of the rounds before it."""
        from fide_plugins.learning.pipeline import learn

        file = folder / f"{name}.fide"
        if file.exists():
            return self._finished(file)

        def report(at: LearnProgress) -> None:
            if on_progress is not None and at.stage == "render":
                on_progress(before + at.done, f"rendering for the {name} model")
            elif on_progress is not None:
                doing = f"{name} {_DOING[at.stage]} {at.done}/{at.total}"
                on_progress(before + renders, doing)

        return learn(
            self.render,
            self.space,
            renders=renders,
            passes=_PASSES,
            size=max(16, min(_SIZE, max(self.picture.shape[:2]))),
            time=None if end is None else max(1.0, end - clock.monotonic()),
            workers=workers,
            out=file,
            seed=self.seed,
            device=self.device,
            on_progress=report,
            **more,
        )

    def _finished(self, file: Path) -> Model:
        """Model of a round that was finished before an interruption.

        Raises OptionError if it is of another version of the renderer.
        """
        from fide_plugins.runtime.registry import version_of

        version_of(self.render)  # raises for one that is no text
        try:
            model: Model = model_for(file, self.render)
        except OptionError as error:
            raise OptionError(
                f"{file.parent} holds models of rounds with another version of the renderer "
                f"({error}); name another run directory, or delete this one"
            ) from error
        return model

    def remove_renders(self) -> None:
        """Remove the renders, which nothing needs once the search has begun."""
        if self.folder is not None:
            for name in ("first", "second"):
                shutil.rmtree(self.folder / f"{name}.fide.renders", ignore_errors=True)

    @property
    def renders(self) -> tuple[int, int]:
        """Of both rounds, whole shards."""
        from fide_plugins.learning.renders import SHARD

        first, second = (round(share * self.budget) // SHARD * SHARD for share in (_FIRST, _SECOND))
        return first, second


def rounds_of(
    render: Any,
    space: Space | int | None,
    picture: Any,
    options: Mapping[str, Any],
    *,
    budget: int | None,
    seed: int,
    out: str | os.PathLike[str] | None,
    seconds: float | None = None,
) -> Rounds | None:
    """Rounds that the options ask for; None where the preset is another one.

    picture: (H, W, 3), or a list of views.  out: run directory.  seconds: of the whole run.

    Raises OptionError for a budget below `LEAST`, for several views, and for `learned` or
    `value_range` beside it.
    """
    if options.get("preset") != GLOBAL:
        return None
    if budget is None or budget < LEAST:
        raise OptionError(
            f"preset='global' renders and learns before it searches, and needs a budget of at "
            f"least {LEAST:,} renders, not {budget}: give one (of a run that is resumed, too), or "
            "take preset='balanced' for another run"
        )
    if options.get("learned") is not None:
        raise OptionError("preset='global' learns a model itself: leave out learned, or the preset")
    if isinstance(picture, list):
        raise OptionError(
            f"preset='global' learns from one picture, and the target is a list of {len(picture)} "
            "views: take another preset"
        )
    if options.get("value_range") is not None:
        raise OptionError(
            "preset='global' learns from images in [0, 1], and value_range scales others: divide "
            "target and renders by the value that is white, or take another preset"
        )
    folder = None if out is None else Path(out) / "rounds"
    limit = None if seconds is None else _TIME * seconds
    device = options.get("device") or "auto"
    return Rounds(render, space, picture, budget, seed % 2**32, folder, limit, device)


def search_options(options: Mapping[str, Any], render: object, *, resumed: bool) -> dict[str, Any]:
    """Options of the search by `FIDE`: those given, with its own preset in place of "global".

    A model takes the place of its file, see `model_for`, which raises and warns.
    resumed: whether the search goes on from a saved state, which has its hypotheses: the model is
        checked, and left out; a warning where its file is gone.
    """
    try:
        found = with_model(options, render)
    except ModelNotFoundError as error:
        if not resumed:
            raise
        warn_user(f"{error}; the saved search has its hypotheses and goes on without the file")
        found = dict(options)
    if resumed:
        found.pop("learned", None)
    if found.get("preset") == GLOBAL:
        found["preset"] = _SEARCH
    return found
