"""DFO-LS: derivative-free least squares on the residuals of image features.

Cartis, Fiala, Marteau and Roberts (2019) fit a linear model of the residual vector, here the
features of an image minus those of the target, within a trust region (Gauss-Newton without
derivatives).  It needs dim + 1 renders to begin and then one at a time.

Through the authors' own package, which is under the GPL and therefore an optional extra:
pip install DFO-LS.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, ClassVar

import numpy as np

from fide_lab.baselines.global_random import GlobalRandom
from fide_lab.baselines.image_features import ImageBased
from fide_lab.baselines.reverse_communication import Search
from fide_lab.baselines.sequential import Sequential
from fide_plugins.errors import OptionError
from fide_plugins.runtime.machine import missing
from fide_plugins.types import Float32, Float64

__all__ = ["DFOLS", "least_squares"]

LONGEST = 100_000  # evaluations of one search; DFO-LS makes a list of that length


class DFOLS(ImageBased, Sequential):
    """Least squares by DFO-LS from near the center of the box; at its end again, from elsewhere.

    sigma0: standard deviation of the first start around the center.  The center itself can be a
        point of symmetry: with all cells of a Voronoi picture on top of each other, moving one
        changes nothing, and the linear model is blind.  Later starts are uniform in the box.
    channels: of the tokens of the encoder; by default the mean colors of 14 x 14 patches.
    radius: of the first trust region, at most 0.5.
    noisy: whether DFO-LS is told that the function is noisy, which makes its radius shrink slowly;
        the default, because an image changes in steps where an edge passes a pixel.
    soft_restarts: whether a search that has converged goes on by DFO-LS's own restarts, from its
        best point with a new radius, before it begins elsewhere.

    Residuals are divided by the root of their number, so the sum of their squares is a mean.  The
    search does not use the loss, which only decides which point is `best`.  The other options are
    those of `ImageBased` and `Baseline`; popsize is 1, and another one has no effect but a warning.

    Raises OptionError, ImageError without a target (ValueErrors), and DependencyError (an
    ImportError) without DFO-LS.
    """

    name: ClassVar[str] = "dfols"

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        channels: int | None = 3,
        radius: float = 0.1,
        noisy: bool = True,
        soft_restarts: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, channels=channels, **options)
        if isinstance(radius, bool) or not isinstance(radius, int | float) or not 0 < radius <= 0.5:
            raise OptionError(f"radius must lie in (0, 0.5], not {radius!r}")
        for option, value in (("noisy", noisy), ("soft_restarts", soft_restarts)):
            if not isinstance(value, bool):
                raise OptionError(f"{option} must be True or False, not {value!r}")
        try:
            import dfols  # noqa: F401
        except ImportError as error:
            raise missing("dfols", "dfols needs the package DFO-LS") from error
        self.radius, self.noisy, self.soft_restarts = float(radius), noisy, soft_restarts
        self._rng = np.random.default_rng(self.seed)
        self._global_random = GlobalRandom(self.seed)

    def _search(self) -> Search:
        if self.starts == 0:
            x0 = np.clip(0.5 + self.sigma0 * self._rng.standard_normal(self.dim), 0.0, 1.0)
        else:
            x0 = self._rng.random(self.dim)
        settings = {"restarts.use_restarts": self.soft_restarts}
        return partial(
            least_squares, x0=x0, radius=self.radius, noisy=self.noisy, settings=settings
        )

    def _answer(self, loss: float, features: Float32 | None) -> Float64:
        assert features is not None
        wrong = features.astype(np.float64) - self.target_features
        residuals: Float64 = wrong / np.sqrt(len(wrong))
        return residuals

    def _surroundings(self) -> Callable[[], AbstractContextManager[None]]:
        return self._global_random.lent_quietly

    def _own_settings(self) -> dict[str, Any]:
        switches = {"noisy": self.noisy, "soft_restarts": self.soft_restarts}
        return {**super()._own_settings(), "radius": self.radius, **switches}


def least_squares(
    function: Any, x0: Float64, radius: float, noisy: bool, settings: dict[str, Any]
) -> None:
    """One search of DFO-LS in the unit box, from x0, until it has converged."""
    import dfols

    dfols.solve(
        function,
        x0,
        bounds=(np.zeros(len(x0)), np.ones(len(x0))),
        rhobeg=radius,
        maxfun=LONGEST,
        objfun_has_noise=noisy,
        user_params=settings,
        do_logging=False,
    )
