"""Base class of Mitsuba tasks: samples per pixel, variants, noise, and rendering.

L [H, W, 3] is linear radiance, the mean over `spp` paths through every pixel; the image is
sRGB(min(L, 1)), the nonlinear encoding of IEC 61966-2-1.  A pixel is the mean of its own paths (a
box filter), so noise is independent between pixels, and of the number of threads.  Noise seeds have
32 bits; the variant scalar multiplies them by H W modulo 2^32.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks import mitsuba_variant
from fide_tasks.base import Image, Task, Vector, reserved_seeds, whole_number

_CHUNK = 2**22  # most paths of one pass of a reference: its noise, hence a target, depends on it
_BLOCK = 16  # pixels across what a thread of scalar draws at once: the noise depends on it as well


class MitsubaTask(Task):
    """A scene that is loaded once and rendered at many values of its parameters.

    A subclass declares `parameters` (as every task), `default_spp`, `default_max_depth`, `_scene`
    and `_update`, and may override `default_reference_spp` and `_integrator`.

    Options, the same in every Mitsuba task
    ---------------------------------------
    spp: paths (samples) per pixel, at least 1; the noise decreases with its square root (slower at
        first, while a single bright path makes a pixel white). None: default of the task.
    max_depth: longest path in segments: 1 shows emitters only, 2 adds direct light, -1 is any
        length. None: default of the task.
    variant: "auto", "cuda", "llvm" or "scalar"; see `mitsuba_variant.choose`. Afterwards the
        attribute `variant` is Mitsuba's name of the one in use.
    threads: number of threads; None: one for each core.
    reference_spp: samples per pixel of `reference` and of a generated target. None: default of the
        task.
    target: the user's own picture, float (H, W, 3) in [0, 1], instead of a generated one.
    """

    stochastic = True
    incidental_options = ("threads",)
    default_spp: ClassVar[int]
    default_max_depth: ClassVar[int]
    default_reference_spp: ClassVar[int] = 1024

    def __init__(
        self,
        size: int | tuple[int, int] = 224,
        seed: int = 0,
        *,
        spp: int | None = None,
        max_depth: int | None = None,
        variant: str = "auto",
        threads: int | None = None,
        reference_spp: int | None = None,
        target: ArrayLike | None = None,
    ) -> None:
        super().__init__(size, seed, target=target)
        self.spp = whole_number("spp", self.default_spp if spp is None else spp, minimum=1)
        judging = self.default_reference_spp if reference_spp is None else reference_spp
        self.reference_spp = whole_number("reference_spp", judging, minimum=1)
        self.max_depth = _checked_depth(self.default_max_depth if max_depth is None else max_depth)
        self.threads = None if threads is None else whole_number("threads", threads, minimum=1)
        self.variant = mitsuba_variant.choose(variant)
        self._loaded: _Loaded | None = None

    @property
    def renderer(self) -> str:
        """Mitsuba's name of the variant: each has other noise, so a run must keep to one."""
        return self.variant

    @abstractmethod
    def _scene(self, mi: Any) -> dict[str, Any]:
        """Return the scene as a dictionary for `mi.load_dict`.

        Its "sensor" needs neither film nor sampler, and an integrator is not needed. Objects that
        are loaded already may be among its values.
        """

    @abstractmethod
    def _update(self, mi: Any, params: Any, values: Vector) -> None:
        """Set the physical values, (dim,), in `params`, `mi.traverse` of the scene."""

    def _integrator(self) -> dict[str, Any]:
        """Return the integrator as a dictionary; by default a path tracer."""
        return {"type": "path", "max_depth": self.max_depth}

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        with self.open():
            for v, seed, frame in zip(values, seeds.tolist(), out, strict=True):
                to_srgb(self._draw(v, seed, self.spp), frame)

    def _reference(self, values: Vector) -> Image:
        return self._converged(values, stream=1)

    def _make_target(self) -> Image:
        if self._x_star is None:
            return super()._make_target()
        return self._converged(self._one(self._x_star), stream=2 + self.seed)

    def _converged(self, values: Vector, stream: int) -> Image:
        """Render with `reference_spp` samples per pixel, in passes of limited size."""
        most = max(1, _CHUNK // (self.size[0] * self.size[1]))
        parts = [most] * (self.reference_spp // most) + [self.reference_spp % most]
        total = np.zeros(self.shape)
        with self.open():
            for seed, spp in zip(reserved_seeds(len(parts), stream).tolist(), parts, strict=True):
                if spp:
                    total += spp * self._draw(values, seed, spp)
        image: Image = np.empty(self.shape, np.float32)
        to_srgb((total / self.reference_spp).astype(np.float32), image)
        return image

    @contextmanager
    def open(self) -> Iterator[None]:
        """Load the scene if need be, and keep Mitsuba to this task."""
        with mitsuba_variant.in_variant(self.variant, self.threads) as mi:
            if self._loaded is None:
                self._loaded = _Loaded(self, mi)
            yield

    def _draw(self, values: Vector, seed: int, spp: int) -> Image:
        """Linear radiance (H, W, 3) of physical values, (dim,); see `open`."""
        assert self._loaded is not None
        scene = self._loaded
        self._update(scene.mi, scene.params, values)
        scene.params.update()
        radiance: Image = np.array(scene.render(seed, spp))
        return radiance

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what belongs to this process."""
        return {**self.__dict__, "_loaded": None}


class _Loaded:
    """A scene in memory, with its camera and integrator."""

    def __init__(self, task: MitsubaTask, mi: Any) -> None:
        height, width = task.size
        description = task._scene(mi)
        film = {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        }
        camera = {**description["sensor"], "film": film, "sampler": {"type": "independent"}}
        self.mi = mi
        self.scene = mi.load_dict({**description, "sensor": camera})
        blocks = {"block_size": _BLOCK} if task.variant.startswith("scalar") else {}
        self.integrator = mi.load_dict({**task._integrator(), **blocks})
        self.sensor = self.scene.sensors()[0]
        self.params = mi.traverse(self.scene)

    def render(self, seed: int, spp: int) -> Any:
        """Return L, computed, as Mitsuba's tensor (H, W, 3)."""
        import drjit as dr

        tensor = self.integrator.render(self.scene, self.sensor, seed=seed, spp=spp)
        dr.eval(tensor)
        dr.sync_thread()
        return tensor


def _checked_depth(max_depth: int) -> int:
    if max_depth == -1 and not isinstance(max_depth, bool):
        return -1
    try:
        return whole_number("max_depth", max_depth, minimum=1)
    except ValueError as error:
        raise ValueError(f"{error}; -1 is any length") from None


def to_srgb(radiance: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Encode linear radiance for a screen, in `out`, which must be another array.

    Radiance above 1 is clipped; what is not finite (a path that failed) is black.
    """
    np.nan_to_num(radiance, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    np.clip(radiance, 0.0, 1.0, out=radiance)
    np.power(radiance, np.float32(1 / 2.4), out=out)
    out *= np.float32(1.055)
    out -= np.float32(0.055)
    np.multiply(radiance, np.float32(12.92), out=out, where=radiance <= 0.0031308)
    np.clip(out, 0.0, 1.0, out=out)
