"""Say what can be used on this machine, and what is missing for the rest.

Each task renders a frame, each encoder and loss takes an image, each optimizer is asked for
candidates.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from fide_plugins.cli.list_command import names
from fide_plugins.cli.messages import plain

__all__ = ["add_arguments", "execute"]

_SIDE = 32  # pixels of the images that are tried

_EXTRAS = {  # extra: distribution that it brings
    "nevergrad": "nevergrad",
    "optuna": "optuna",
    "robot": "mujoco",
    "mitsuba": "mitsuba",
    "dinov3": "transformers",
    "dask": "distributed",
    "report": "jinja2",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide doctor``."""
    parser.add_argument("--json", action="store_true", help="one line of JSON instead of text")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Run it; returns the exit code."""
    facts = examine()
    print(json.dumps(facts) if args.json else _text(facts))
    return 0


def examine() -> dict[str, Any]:
    """Versions, machine, and for each thing that has a name None or what is wrong with it."""
    import torch  # noqa: F401  so that the machine's devices are known

    from fide_plugins.harness import machine

    return {
        "versions": machine.versions(),
        "machine": machine.machine(),
        "mitsuba": _try_mitsuba(),
        "tasks": _try_all("tasks", _try_task),
        "optimizers": _try_all("optimizers", _try_optimizer),
        "encoders": _try_all("encoders", _try_encoder),
        "losses": _try_all("losses", _try_loss),
        "extras": {extra: machine.version_of(package) for extra, package in _EXTRAS.items()},
    }


def _try_all(kind: str, attempt: Callable[[str], None]) -> dict[str, str | None]:
    results: dict[str, str | None] = {}
    for name in names(kind):
        try:
            attempt(name)
            results[name] = None
        except Exception as error:  # whatever it is, it is the diagnosis
            results[name] = plain(error) or type(error).__name__
    return results


def _image() -> Any:
    import numpy as np

    return np.linspace(0, 1, _SIDE * _SIDE * 3, dtype=np.float32).reshape(_SIDE, _SIDE, 3)


def _try_task(name: str) -> None:
    import numpy as np

    import fide_tasks

    task = fide_tasks.make(name, size=_SIDE)
    task.render(np.full((1, task.dim), 0.5))


def _try_mitsuba() -> dict[str, str]:
    """What there is to say of each variant of Mitsuba."""
    from fide_tasks import mitsuba_variant

    if mitsuba_variant.problem_with("scalar"):
        return {"mitsuba": f"not installed: {mitsuba_variant.REMEDIES['scalar']}"}
    facts = {}
    for short, name in mitsuba_variant.VARIANTS.items():
        problem = mitsuba_variant.problem_with(short)
        facts[name] = f"no: {problem}; {mitsuba_variant.REMEDIES[short]}" if problem else "ok"
    if facts["llvm_ad_rgb"] == "ok":
        facts["llvm_ad_rgb"] = (
            f"ok, with {mitsuba_variant.library() or 'a library it finds itself'}"
        )
    return {name: plain(text) for name, text in facts.items()}


def _try_optimizer(name: str) -> None:
    from fide_plugins import optimizers

    optimizers.make(name, 2, _image(), seed=0).ask()


def _try_encoder(name: str) -> None:
    from fide_plugins import encoders

    encoders.make(name)(_image()[None])


def _try_loss(name: str) -> None:
    from fide_plugins import losses

    losses.make(name, _image())(_image()[None])


def _text(facts: dict[str, Any]) -> str:
    versions, machine = facts["versions"], facts["machine"]
    lines = ["  ".join(f"{name} {version}" for name, version in versions.items())]
    lines.append(f"{machine['cpu']}, {machine['cores']} cores, {machine['threads']} threads")
    lines.append(f"CUDA: {machine.get('cuda') or 'none, everything runs on the processor'}")
    lines.append("\nMitsuba's variants; the first that runs is the default")
    width = max(map(len, facts["mitsuba"]))
    lines += [f"  {name:{width}}  {text}" for name, text in facts["mitsuba"].items()]
    for kind in ("tasks", "optimizers", "encoders", "losses"):
        lines.append(f"\n{kind}")
        width = max(map(len, facts[kind]), default=0)
        for name, problem in facts[kind].items():
            lines.append(f"  {name:{width}}  {problem or 'ok'}")
    lines.append("\nextras")
    width = max(map(len, facts["extras"]))
    for extra, version in facts["extras"].items():
        state = version or f"not installed: pip install 'fide-plugins[{extra}]'"
        lines.append(f"  {extra:{width}}  {state}")
    return "\n".join(lines)
