"""Compare optimizers on one task: the same target, the same budget, several seeds."""

from __future__ import annotations

import numpy as np

from fide_lab import run as harness

BUDGET, SEEDS = 600, range(2)


def main() -> None:
    print(f"{'optimizer':10} {'median MSE':>10} {'ms an evaluation, without rendering':>36}")
    for optimizer in ("fide", "cma", "random"):
        results = [harness.run("spline", optimizer, "mse", BUDGET, seed, size=64) for seed in SEEDS]
        mse = np.median([result.mse for result in results])
        overhead = np.median([result.overhead_s / result.evaluations for result in results])
        print(f"{optimizer:10} {mse:10.4f} {1000 * overhead:36.2f}")


if __name__ == "__main__":
    main()
