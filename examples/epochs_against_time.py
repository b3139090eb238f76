"""How long to train the published denoiser in each generation: epochs against time.

More epochs cost time and, up to a point, save renders (the paper uses 4 to 20).

    python examples/epochs_against_time.py
    python examples/epochs_against_time.py --size 224 --popsize 500 --budget 25000 --epochs 4 10 20

The first command takes half a minute, the second hours.
"""

from __future__ import annotations

import argparse

from fide_lab import run as harness


def main() -> None:
    """Run the published method with each number of epochs, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--task", default="spline")
    parser.add_argument("--size", type=int, default=64, help="image side, pixels")
    parser.add_argument("--epochs", type=int, nargs="+", default=[1, 4, 12])
    parser.add_argument("--popsize", type=int, default=40)
    parser.add_argument("--budget", type=int, default=800, help="renders")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print("epochs   MSE at half   MSE at end   s training   s in all")
    for epochs in args.epochs:
        result = harness.run(
            args.task,
            "fide",
            "mse",
            args.budget,
            args.seed,
            size=args.size,
            options={
                "preset": "paper",
                "epochs": epochs,
                "popsize": args.popsize,
            },
        )
        half = result.losses[: args.budget // 2].min()
        numbers = f"{half:14.4f}{result.best_loss:13.4f}"
        print(f"{epochs:6d}{numbers}{result.times['train']:13.1f}{result.wall_s:11.1f}", flush=True)


if __name__ == "__main__":
    main()
