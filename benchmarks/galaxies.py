"""Measures galaxies that overlap: FIDE beside AstroPhot, on the same counts.

    pip install galsim astrophot
    python benchmarks/galaxies.py --table   # without --table: measure what is missing

Ten images of two random Sersic galaxies each, as in `examples/galaxy.py`: GalSim draws them, the
sky and the point spread function are known, photons and detector make noise.  Nobody gets a guess.
FIDE is `fit` with at most 800 renders, then SciPy's least squares from there.
AstroPhot starts from what it estimates itself (`initialize`), or with the places that peaks of
the image give ("peaks"), and fits by Levenberg-Marquardt with exact derivatives.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from rows import Row, by_key, command
from scipy.ndimage import gaussian_filter
from scipy.special import gamma, gammaincinv

from fide_plugins import fit

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "examples"))
galaxy: Any = import_module("galaxy")
RESULTS = ROOT / "benchmarks" / "results" / "galaxies.jsonl"
METHODS, TARGETS, RENDERS = ("fide", "astrophot", "peaks"), range(10), 800
SOLVED = 0.02
"""Mean square of the difference between found and true counts, in variances of the noise, at most;
the best fit has about 14 / 48^2 = 0.006."""


def truth(number: int) -> dict[str, float]:
    """Two galaxies, at most 2 arc seconds from the middle in each direction."""
    rng = np.random.default_rng(number)
    found: dict[str, Any] = {}
    for which in "ab":
        turn, stretch = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.4)
        found |= {
            f"x_{which}": rng.uniform(-2, 2), f"y_{which}": rng.uniform(-2, 2),
            f"flux_{which}": np.exp(rng.uniform(*np.log([3e4, 3e5]))),
            f"radius_{which}": np.exp(rng.uniform(*np.log([0.4, 1.5]))),
            f"sersic_{which}": rng.uniform(0.8, 4),
            f"g1_{which}": stretch * np.cos(turn), f"g2_{which}": stretch * np.sin(turn),
        }  # fmt: skip
    return {name: float(value) for name, value in found.items()}


def counts(number: int) -> NDArray[np.float64]:
    """Electrons that the detector counts, (48, 48)."""
    rng, clean = np.random.default_rng((number, 1)), galaxy.expected(truth(number))
    return np.asarray(rng.poisson(clean) + rng.normal(0, galaxy.READ, clean.shape))


def by_fide(data: NDArray[np.float64], seed: int) -> tuple[dict[str, float], int]:
    """Parameters, and number of renders."""
    how: dict[str, Any] = {"workers": 0, "seed": seed, "value_range": (0, 128)}
    result = fit(galaxy.render, galaxy.stretch(data), galaxy.SPACE, RENDERS, **how)
    return result.params, result.evaluations


def refined(data: NDArray[np.float64], found: dict[str, float]) -> tuple[dict[str, float], int]:
    """Parameters by least squares from there, and number of renders."""
    end, count = galaxy.refine(galaxy.SPACE.encode(found), galaxy.stretch(data), 150)
    return galaxy.SPACE.decode(end.x - 1), count


def peaks(data: NDArray[np.float64]) -> list[list[float]]:
    """Places of the two highest pixels of the smoothed image, 3 pixels apart, in arcsec."""
    smooth, found = gaussian_filter(data, 1.0), []
    down, across = np.indices(data.shape)
    top = smooth >= np.max([np.roll(smooth, s, (0, 1)) for s in product((-1, 0, 1), repeat=2)], 0)
    smooth = np.where(top, smooth, 0)
    for _ in "ab":
        i, j = np.unravel_index(smooth.argmax(), data.shape)
        found.append([float(at - (galaxy.SIDE - 1) / 2) * galaxy.SCALE for at in (j, i)])
        smooth[np.hypot(down - i, across - j) < 3] = 0
    return found


def by_astrophot(data: NDArray[np.float64], places: list[Any]) -> tuple[dict[str, float], int]:
    """Parameters, and number of steps."""
    logging.root.addHandler(logging.NullHandler())  # without one, AstroPhot writes a file
    galsim, ap = import_module("galsim"), import_module("astrophot")
    fine = galsim.ImageD(75, 75, scale=galaxy.SCALE / 3)
    star = galsim.Moffat(beta=3.0, fwhm=0.7).drawImage(fine, method="no_pixel").array
    target = ap.TargetImage(
        data=data - galaxy.SKY, variance=np.clip(data, 1, None) + galaxy.READ**2,
        pixelscale=galaxy.SCALE, crpix=((galaxy.SIDE - 1) / 2,) * 2,
        psf=ap.PSFImage(data=star, upsample=3),
    )  # fmt: skip
    models = [
        ap.Model(model_type="sersic galaxy model", target=target, name=which,
                 **({"center": place} if place else {}))
        for which, place in zip("ab", places, strict=True)
    ]  # fmt: skip
    both = ap.Model(model_type="group model", models=models, target=target, name="both")
    both.initialize()
    steps = len(ap.fit.LM(both, verbose=0).fit().loss_history)
    found: dict[str, float] = {}
    for which, model in zip("ab", models, strict=True):
        x, y = (float(v) for v in model.center.value)
        q, angle, n, radius, bright = (
            float(getattr(model, name).value) for name in ("q", "PA", "n", "Re", "Ie")
        )
        b, shear = gammaincinv(2 * n, 0.5), (1 - q) / (1 + q)
        flux = 2 * np.pi * q * radius**2 * bright * n * np.exp(b) * b ** (-2 * n) * gamma(2 * n)
        turn = 2 * (angle - np.pi / 2)
        values = x, y, flux, radius * np.sqrt(q), n, shear * np.cos(turn), shear * np.sin(turn)
        names = (f"{name}_{which}" for name in galaxy.GALAXY)
        found |= {name: float(value) for name, value in zip(names, values, strict=True)}
    return found, steps


def matched(found: dict[str, float], true: dict[str, float]) -> dict[str, float]:
    """The galaxies in the order of the true ones, which are nearer in sum."""

    def apart(p: dict[str, float]) -> float:
        return sum(abs(p[name] - true[name]) for name in true if name[0] in "xy")

    other = {n[:-1] + {"a": "b", "b": "a"}[n[-1]]: v for n, v in found.items()}
    return min(found, other, key=apart)


def key(row: Row) -> tuple[str, int]:
    """What makes a run."""
    return row["method"], row["target"]


def judged(found: dict[str, float], true: dict[str, float]) -> Row:
    """How far the answer is from the truth: counts, and the worse galaxy's parameters."""
    clean = galaxy.expected(true)
    try:  # GalSim draws indices from 0.3 to 6.2 only
        error = np.mean((galaxy.expected(found) - clean) ** 2 / (clean + galaxy.READ**2))
    except Exception as failure:
        return {"error": np.inf, "failure": str(failure)[:100]}
    found = matched(found, true)
    off = {
        "place": max(abs(found[n] - true[n]) for n in true if n[0] in "xy"),
        "flux": max(abs(found[n] / true[n] - 1) for n in true if n.startswith("flux")),
        "index": max(abs(found[n] - true[n]) for n in true if n.startswith("sersic")),
    }
    return {"found": found, "error": float(error), "off": off}


def measure(run: Row) -> Row:
    """Fit one image."""
    method, number = key(run)
    data, true, start = counts(number), truth(number), time.process_time()
    if method == "fide":
        found, count = by_fide(data, number)
    else:
        found, count = by_astrophot(data, peaks(data) if method == "peaks" else [None, None])
    row = {**run, "seconds": time.process_time() - start, "count": count, **judged(found, true)}
    if method == "fide":
        start = time.process_time()
        found, count = refined(data, found)
        seconds = time.process_time() - start
        row["refined"] = {"seconds": seconds, "count": count, **judged(found, true)}
    return row


def table(rows: list[Row]) -> str:
    """Images solved, and errors of the worse galaxy's parameters where solved."""
    found = by_key(rows, key)
    lines = ["| | solved | error | place | flux | index | steps | seconds |", "|---" * 8 + "|"]
    each = {method: [found[method, number] for number in TARGETS] for method in METHODS}
    each["then least squares"] = [row["refined"] for row in each["fide"]]
    for method, those in each.items():
        good = [row for row in those if row["error"] < SOLVED]
        cells = [f"{len(good)} of {len(those)}", f"{np.median([r['error'] for r in those]):.4f}"]
        cells += [
            f"{np.median([r['off'][n] for r in good]):.3f}" for n in ("place", "flux", "index")
        ]
        cells += [f"{np.median([r[n] for r in those]):.0f}" for n in ("count", "seconds")]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    runs = ({"method": m, "target": n} for n, m in product(TARGETS, METHODS))
    command(__doc__ or "", runs, measure, RESULTS, key, table)
