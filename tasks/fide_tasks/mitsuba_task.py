"""Base class of Mitsuba tasks: samples per pixel, variants, noise, and rendering.

Notation: L [H, W, 3] linear radiance, the mean over `spp` paths through every pixel; the image is
sRGB(min(L, 1)), the nonlinear encoding of IEC 61966-2-1.

Paths are independent and a pixel is the mean of its own paths (a box filter), so the noise of
different pixels is independent, and a frame is bit-identical on any number of threads.

Noise seeds have 32 bits, so two frames have the same noise with a probability of 2^-32. With the
variant scalar it is larger: Mitsuba multiplies the seed by H W modulo 2^32 there, which leaves
2^32 / gcd(H W, 2^32) kinds of noise: 16.8 million at 112 x 112, but 65,536 at 256 x 256 and 4,096
at 1024 x 1024.
"""

from __future__ import annotations

import copy
import threading
import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks import mitsuba_variant
from fide_tasks.base import Image, Task, Vector, reserved_seeds, whole_number
from fide_tasks.render_workers import Job, RenderWorkers, cores

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
    denoise: whether OptiX denoises each frame (not the reference), with variant "cuda" only.
    workers: number of processes that share the candidates of one `render`. 1 renders in this
        process, which a crash of the renderer ends and a hang blocks. One process already uses all
        cores, so more are faster only for frames of about 32 pixels; but with more, a crash or a
        hang becomes a `RenderWorkerError`, after which rendering can continue.
    threads: number of threads of each process; None divides all cores among the processes.
    reference_spp: samples per pixel of `reference` and of a generated target. None: default of the
        task.
    target: the user's own picture, float (H, W, 3) in [0, 1], instead of a generated one.

    Attributes
    ----------
    times: seconds spent so far in "load", "update", "render" (its first frame compiles) and "copy"
        (out of the renderer and encoded into the image), and the number of "frames".
    """

    stochastic = True
    incidental_options = ("workers", "threads")
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
        denoise: bool = False,
        workers: int = 1,
        threads: int | None = None,
        reference_spp: int | None = None,
        target: ArrayLike | None = None,
    ) -> None:
        super().__init__(size, seed, picture=target)
        self.spp = whole_number("spp", self.default_spp if spp is None else spp, minimum=1)
        judging = self.default_reference_spp if reference_spp is None else reference_spp
        self.reference_spp = whole_number("reference_spp", judging, minimum=1)
        self.max_depth = _checked_depth(self.default_max_depth if max_depth is None else max_depth)
        self.threads = None if threads is None else whole_number("threads", threads, minimum=1)
        self.workers = whole_number("workers", workers, minimum=1)
        self.variant = mitsuba_variant.choose(variant)
        self.denoise = self._checked_denoise(denoise)
        self.times = {"load": 0.0, "update": 0.0, "render": 0.0, "copy": 0.0, "frames": 0}
        self._loaded: _Loaded | None = None
        self._pool: RenderWorkers | None = None
        self._lock = threading.Lock()  # threads take turns with the pool

    def _checked_denoise(self, denoise: bool) -> bool:
        if not isinstance(denoise, bool):
            raise ValueError(f"denoise must be True or False, not {denoise!r}")
        if denoise and not self.variant.startswith("cuda"):
            raise ValueError(
                "denoise=True needs Mitsuba's OptiX denoiser, which runs with variant 'cuda' only; "
                f"here it is {self.variant}: leave denoise out, and raise spp for less noise"
            )
        if denoise and (problem := mitsuba_variant.problem_with_denoiser()):
            raise ValueError(
                "denoise=True needs Mitsuba's OptiX denoiser, which does not run here "
                f"({problem}): leave denoise out, or, if the NVIDIA driver lacks its file "
                "nvoptix.bin, as in many containers, provide that"
            )
        return denoise

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
        pairs = zip(values, seeds.tolist(), strict=True)
        self._draw_all([Job(v, seed, self.spp, encoded=True) for v, seed in pairs], out)

    def _reference(self, values: Vector) -> Image:
        return self._converged(values, stream=1)

    def _make_target(self) -> Image:
        if self._x_star is None:
            return super()._make_target()
        return self._converged(self._one(self._x_star), stream=2 + self.seed)

    def _converged(self, values: Vector, stream: int) -> Image:
        """Render with `reference_spp` samples per pixel, in passes that processes can share."""
        height, width = self.size
        most = max(1, _CHUNK // (height * width))
        parts = [most] * (self.reference_spp // most) + [self.reference_spp % most]
        seeds = reserved_seeds(len(parts), stream).tolist()
        jobs = [Job(values, s, n, encoded=False) for s, n in zip(seeds, parts, strict=True) if n]
        total = np.zeros(self.shape)
        some: Image = np.empty((self.workers, *self.shape), np.float32)
        for i in range(0, len(jobs), self.workers):
            batch = jobs[i : i + self.workers]
            self._draw_all(batch, some[: len(batch)])
            for job, radiance in zip(batch, some, strict=False):
                total += job.spp * radiance
        image: Image = np.empty(self.shape, np.float32)
        to_srgb((total / self.reference_spp).astype(np.float32), image)
        return image

    def _draw_all(self, jobs: list[Job], out: Image) -> None:
        """Draw frames into out, (n, H, W, 3), in this process or in others."""
        if self.workers == 1:
            with self.open():
                for job, frame in zip(jobs, out, strict=True):
                    self.draw(job, frame)
        elif jobs:
            with self._lock:
                if self._pool is None or self._pool.closed:
                    share = self.threads or max(1, cores() // self.workers)
                    self._pool = RenderWorkers(self._alone(share), self.workers, self.shape)
                self._pool.render(jobs, out)

    def _alone(self, threads: int) -> MitsubaTask:
        """Return this task as one process has it; its times are these."""
        task = copy.copy(self)
        task.workers, task.threads, task.times = 1, threads, self.times
        return task

    @contextmanager
    def open(self) -> Iterator[None]:
        """Load the scene if need be; within this context `draw` may be called."""
        with mitsuba_variant.in_variant(self.variant, self.threads) as mi:
            if self._loaded is None:
                start = time.perf_counter()
                self._loaded = _Loaded(self, mi)
                self.times["load"] += time.perf_counter() - start
            yield

    def draw(self, job: Job, out: Image) -> None:
        """Draw one frame into out, (H, W, 3), encoded or as linear radiance; see `open`."""
        assert self._loaded is not None
        scene, clock = self._loaded, time.perf_counter
        start = clock()
        self._update(scene.mi, scene.params, job.values)
        scene.params.update()
        updated = clock()
        radiance = scene.render(job.seed, job.spp, denoised=self.denoise and job.encoded)
        rendered = clock()
        if job.encoded:
            to_srgb(np.array(radiance), out)
        else:
            out[:] = np.array(radiance)
        self.times["update"] += updated - start
        self.times["render"] += rendered - updated
        self.times["copy"] += clock() - rendered
        self.times["frames"] += 1

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what belongs to this process."""
        state = {**self.__dict__, "_loaded": None, "_pool": None}
        del state["_lock"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()


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
        self._denoiser = mi.OptixDenoiser([width, height]) if task.denoise else None

    def render(self, seed: int, spp: int, denoised: bool) -> Any:
        """Return L, computed, as Mitsuba's tensor (H, W, 3)."""
        import drjit as dr

        tensor = self.integrator.render(self.scene, self.sensor, seed=seed, spp=spp)
        if denoised and self._denoiser is not None:
            tensor = self._denoiser(tensor)
        dr.eval(tensor)
        dr.sync_thread()
        return tensor


def _checked_depth(max_depth: int) -> int:
    try:
        depth = whole_number("max_depth", max_depth, minimum=-1)
    except ValueError:
        depth = 0
    if depth == 0:
        raise ValueError(
            f"max_depth must be a whole number >= 1, or -1 for any length, not {max_depth!r}"
        )
    return depth


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
