"""Measure two galaxies that overlap, from noisy counts (GalSim), beside a least-squares fit.

    python examples/galaxy.py          # a short run
    python examples/galaxy.py 800     # the run of the page "Fit galaxies"

Fourteen parameters: place, flux, half-light radius, Sersic index and ellipticity of both.  The sky
and the point spread function are known; photons and detector make noise.  Without GalSim it says so
and ends.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fide_plugins import Float, Space, fit

SIDE, SCALE = 48, 0.2  # pixels, arc seconds per pixel
SKY, READ = 200.0, 5.0  # electrons a pixel: the sky, and the root mean square of the detector
FULL = 4000.0  # electrons that a pixel holds
GALAXY = {
    "x": Float(-3, 3, unit="arcsec"), "y": Float(-3, 3, unit="arcsec"),
    "flux": Float(1e4, 4e5, unit="e-", log=True),
    "radius": Float(0.3, 2.5, unit="arcsec", log=True),
    "sersic": Float(0.6, 5), "g1": Float(-0.5, 0.5), "g2": Float(-0.5, 0.5),
}  # fmt: skip
SPACE = Space({f"{name}_{which}": kind for which in "ab" for name, kind in GALAXY.items()})
TRUTH = {
    "x_a": -0.6, "y_a": 0.3, "flux_a": 1.6e5, "radius_a": 1.1, "sersic_a": 3.2, "g1_a": 0.2,
    "g2_a": 0.1, "x_b": 1.1, "y_b": -0.7, "flux_b": 6e4, "radius_b": 0.7, "sersic_b": 1.0,
    "g1_b": -0.25, "g2_b": 0.2,
}  # fmt: skip


def expected(p: dict[str, float], step: float = 0.001) -> NDArray[np.float64]:
    """Electrons in each pixel without noise, (SIDE, SIDE).

    step: to which Sersic indices are rounded, since GalSim needs some 50 ms to prepare one.
    """
    galsim: Any = import_module("galsim")
    star = galsim.Moffat(beta=3.0, fwhm=0.7)
    speed = galsim.GSParams(folding_threshold=0.02, maximum_fft_size=8192)
    image = galsim.ImageD(SIDE, SIDE, scale=SCALE, init_value=SKY)
    for which in "ab":
        index = step * round(p[f"sersic_{which}"] / step)
        shape = galsim.Sersic(index, half_light_radius=p[f"radius_{which}"], trunc=0)
        shape = shape.withFlux(p[f"flux_{which}"]).shear(g1=p[f"g1_{which}"], g2=p[f"g2_{which}"])
        seen = galsim.Convolve(shape.shift(p[f"x_{which}"], p[f"y_{which}"]), star, gsparams=speed)
        seen.drawImage(image, add_to_image=True)
    return np.asarray(image.array, float)


def observed(seed: int) -> NDArray[np.float64]:
    """Electrons that a detector counts."""
    rng = np.random.default_rng(seed)
    return rng.poisson(expected(TRUTH)) + rng.normal(0, READ, (SIDE, SIDE))


def stretch(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of which noise has the same strength, 1, in dark and in bright pixels (Anscombe)."""
    return 2 * np.sqrt(np.clip(counts, 0, FULL) + READ**2 + 3 / 8)


def render(p: dict[str, float]) -> NDArray[np.float64]:
    return stretch(expected(p, 0.05))


def mean_square(image: NDArray[np.float64], target: NDArray[np.float64]) -> float:
    """Mean square of the residuals, each in standard deviations: 1 where only noise is left."""
    return float(np.mean((image - target) ** 2))


def refine(start: NDArray[np.float64], target: NDArray[np.float64], most: int) -> tuple[Any, int]:
    """Least squares from a point (14,) of the unit cube: result of SciPy, and number of renders."""
    count = 0

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal count
        count += 1
        return (stretch(expected(SPACE.decode(x - 1))) - target).ravel()

    start = 1 + np.clip(start, 0.01, 0.99)  # derivatives are differences of steps relative to this
    steps = max(1, most // (SPACE.dim + 1))
    end = least_squares(residuals, start, bounds=(1, 2), diff_step=0.003, max_nfev=steps)
    return end, count


def brighter_first(p: dict[str, float]) -> dict[str, float]:
    """Which galaxy is a, and which b, nobody can say: a is the brighter one."""
    if p["flux_a"] >= p["flux_b"]:
        return p
    return {
        f"{name}_{which}": p[f"{name}_{other}"] for which, other in ("ab", "ba") for name in GALAXY
    }


def save_picture(target: NDArray[np.float64], found: dict[str, float], file: Path) -> None:
    """Counts, model and residuals."""
    figure = Figure(figsize=(8, 2.9), layout="constrained")
    counts, model, rest = figure.subplots(1, 3)
    image = render(found)
    limits: dict[str, Any] = {"vmin": target.min(), "vmax": target.max(), "origin": "lower"}
    counts.imshow(target, cmap="magma", **limits)
    model.imshow(image, cmap="magma", **limits)
    shown = rest.imshow(target - image, cmap="RdBu", vmin=-4, vmax=4, origin="lower")
    figure.colorbar(shown, ax=rest, label="standard deviations")
    for axis, title in zip((counts, model, rest), ("counts", "FIDE", "residuals"), strict=True):
        axis.set(title=title, xticks=[], yticks=[])
    figure.savefig(file, dpi=110)


def main(budget: int) -> None:
    if find_spec("galsim") is None:
        print("no GalSim here: pip install galsim")
        return
    target, out = stretch(observed(0)), Path(f"runs/galaxy-{budget}")
    how: dict[str, Any] = {"workers": 0, "seed": 0, "value_range": (0, 128), "resume": True}
    result = fit(render, target, SPACE, budget=budget, out=out, **how)
    print(result)
    print(f"residuals of the truth {mean_square(render(TRUTH), target):.3f}")
    print(f"FIDE, {budget} renders: {mean_square(render(result.params), target):.3f}")
    end, count = refine(SPACE.encode(result.params), target, 110)
    print(f"refined by least squares, {count} more: {2 * end.cost / target.size:.3f}")
    sigma = np.sqrt(np.diag(np.linalg.pinv(end.jac.T @ end.jac)))
    low, high = (
        brighter_first(SPACE.decode(np.clip(end.x - 1 + s, 0, 1))) for s in (-sigma, sigma)
    )
    found = brighter_first(SPACE.decode(end.x - 1))
    for name, true in TRUTH.items():
        print(f"{name:10} {true:>8}  {found[name]:.4g}  ({low[name]:.4g} to {high[name]:.4g})")
    save_picture(target, found, out / "galaxies.png")
    for seed in range(max(1, budget // 200)):
        start = np.random.default_rng(seed).random(SPACE.dim)
        end, count = refine(start, target, budget // 2)
        print(f"least squares from a random start, {count}: {2 * end.cost / target.size:.3f}")
    print(f"look at {out}/galaxies.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 120)
