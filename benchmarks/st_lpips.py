"""ST-LPIPS (Ghildyal and Liu 2022) as a loss, and its VGG trunk as an encoder; a trial.

    pip download --no-deps stlpips-pytorch==0.0.2 && unzip stlpips_pytorch-0.0.2-*.whl -d runs/st
    python benchmarks/st_lpips.py --targets 320-329 --arms mse perceptual st-lpips
    python benchmarks/st_lpips.py --table runs/st.jsonl

The weights are in the package.  Its modules import torchvision, torchsummary and IPython, which
these networks do not use; what it has of Adobe's filters is CC BY-NC-SA.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from moves import span
from rows import Row, read, run_missing

import fide_tasks
from fide_plugins import FIDE, encoders, losses
from fide_plugins.encoders.pretrained.network import NetworkEncoder
from fide_plugins.losses.base import LossOfTarget

SIZE, BUDGET = 64, 1000
SCENES: dict[str, dict[str, Any]] = {"voronoi": {}, "spline": {"target": "random"}, "robot": {}}
ARMS: dict[str, dict[str, Any]] = {
    "mse": {},
    "perceptual": {"loss": "perceptual"},
    "st-lpips": {"loss": "st-lpips"},
    "vgg": {"encoder": "st-vgg"},
}
NETWORKS: dict[str, Any] = {}


def network(kind: str) -> Any:
    """The package's own network, "alex" or "vgg", with its heads."""
    if kind not in NETWORKS:
        for name in ("torchvision", "torchsummary", "IPython"):
            sys.modules.setdefault(name, ModuleType(name))
        sys.modules["torchvision"].models = None  # type: ignore[attr-defined]
        sys.modules["torchsummary"].summary = None  # type: ignore[attr-defined]
        sys.modules["IPython"].embed = None  # type: ignore[attr-defined]
        sys.path.insert(0, "runs/st")
        from stlpips_pytorch import stlpips

        made = stlpips.LPIPS(net=kind, variant="shift_tolerant", verbose=False)
        NETWORKS[kind] = made.eval().requires_grad_(False)
    return NETWORKS[kind]


class STLPIPS(LossOfTarget):
    """Weighted squared differences of unit activations of AlexNet."""

    name, version = "st-lpips", "1"

    def __init__(self, target: object) -> None:
        super().__init__(target)
        self._network = network("alex")
        self._seen = self._activations(self.target)

    def _activations(self, image: Any) -> list[torch.Tensor]:
        x = torch.tensor(image).permute(2, 0, 1)[None] * 2 - 1
        if self._network.version == "0.1":
            x = self._network.scaling_layer(x)
        with torch.inference_mode():
            layers = self._network.net(x)
            return [y / (y.square().sum(1, keepdim=True).sqrt() + 1e-10) for y in layers]

    def _distance(self, image: Any) -> float:
        pairs = zip(self._network.lins, self._activations(image), self._seen, strict=True)
        with torch.inference_mode():
            return float(sum(head((y - t) ** 2).mean() for head, y, t in pairs))


class Trunk(NetworkEncoder):
    """The fourth stage of the VGG network: positions of 8 x 8 pixels, 512 channels."""

    name = "st-vgg"

    def __init__(self, *, device: str = "cpu") -> None:
        super().__init__(device=device, mean=[0.485, 0.456, 0.406], std=[0.229, 0.224, 0.225])
        net = network("vgg").net
        self.parts = torch.nn.Sequential(net.slice1, net.slice2, net.slice3, net.slice4)
        self.patch, self.channels, self.weights_digest, self.version = 8, 512, "-", "st-vgg-1"

    def _features(self, images: torch.Tensor) -> torch.Tensor:
        sides = images.shape[2] // 8, images.shape[3] // 8
        h = torch.nn.functional.adaptive_avg_pool2d(self.parts(images), sides)
        return h.flatten(2).transpose(1, 2)


def run(planned: Row) -> Row:
    """One run of FIDE; mse of the best by its own loss, and the error of its parameters."""
    scene = planned["scene"]
    task = fide_tasks.make(scene, SIZE, planned["target"], **SCENES[scene])
    opt = FIDE(task.dim, task.target, seed=0, **ARMS[planned["arm"]])
    began = time.process_time()
    while opt.evaluations < BUDGET:
        X = opt.ask_ready()
        opt.tell(X, task.render(X))
    seconds = time.process_time() - began
    assert opt.best is not None and task.x_star is not None
    x = opt.best.x
    mse = float(np.square(task.render(x[None])[0] - task.target).mean())
    error = float(np.sqrt(np.square(x - task.x_star).mean()))
    return {**planned, "mse": mse, "error": error, "cpu_s": round(seconds, 1)}


def table(rows: list[Row]) -> str:
    """Medians, and on how many targets an arm is better than `mse`."""
    lines = ["| scene | arm | targets | mse | lower than with mse | error | lower | CPU s |"]
    lines.append("|---|---|" + "---:|" * 6)
    for scene in SCENES:
        own = {row["target"]: row for row in rows if row["scene"] == scene and row["arm"] == "mse"}
        for arm in ARMS:
            mine = [row for row in rows if (row["scene"], row["arm"]) == (scene, arm)]
            if not mine:
                continue
            cells = [scene, arm, str(len(mine))]
            for key in ("mse", "error"):
                lower = sum(row[key] < own[row["target"]][key] for row in mine)
                cells += [f"{np.median([row[key] for row in mine]):.3g}", str(lower)]
            cells.append(f"{np.median([row['cpu_s'] for row in mine]):.3g}")
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--targets", type=span, default=range(320, 330), metavar="A-B")
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=list(ARMS))
    parser.add_argument("--out", type=Path, default=Path("runs/st.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    losses.register("st-lpips", STLPIPS)
    encoders.register("st-vgg", Trunk)
    planned = [
        {"scene": scene, "target": target, "arm": arm}
        for target in arguments.targets
        for arm in arguments.arms
        for scene in SCENES
    ]
    run_missing(planned, run, arguments.out, lambda row: (row["scene"], row["target"], row["arm"]))


if __name__ == "__main__":
    main()
