"""Find the knobs of a procedural material: marble, drawn by a fragment shader (OpenGL, moderngl).

    python examples/shader.py          # a short run
    python examples/shader.py 2000     # the run of the gallery, with its film

Writes a film of the best image so far.  Without moderngl or OpenGL it says so and ends.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fide_plugins import Float, Space, fit
from fide_plugins.fitting.callbacks import Event

SIDE = 96
SPACE = Space(
    scale=Float(1, 6), turn=Float(0, 180, unit="deg", periodic=True), veins=Float(2, 10),
    warp=Float(0, 3), sharpness=Float(0.5, 4), light=Float(-1, 1),
    stone_r=Float(0, 1), stone_g=Float(0, 1), stone_b=Float(0, 1),
    vein_r=Float(0, 1), vein_g=Float(0, 1), vein_b=Float(0, 1),
)  # fmt: skip
TRUTH = {
    "scale": 3.0, "turn": 35.0, "veins": 5.0, "warp": 1.2, "sharpness": 1.5, "light": 0.4,
    "stone_r": 0.9, "stone_g": 0.88, "stone_b": 0.8, "vein_r": 0.15, "vein_g": 0.3, "vein_b": 0.4,
}  # fmt: skip
VERTEX = "#version 330\nin vec2 at; void main() { gl_Position = vec4(at, 0, 1); }"
FRAGMENT = """#version 330
uniform float scale, turn, veins, warp, sharpness, light, side;
uniform vec3 stone, vein;
out vec4 color;
float hash(vec2 p) { return fract(sin(dot(p, vec2(127.1, 311.7))) * 43758.5453); }
float noise(vec2 p) {
    vec2 i = floor(p), f = fract(p), s = f * f * (3 - 2 * f);
    return mix(mix(hash(i), hash(i + vec2(1, 0)), s.x),
               mix(hash(i + vec2(0, 1)), hash(i + vec2(1, 1)), s.x), s.y);
}
float fractal(vec2 p) {
    float sum = 0, weight = 0.5;
    for (int octave = 0; octave < 5; octave++) {
        sum += weight * noise(p); p *= 2.03; weight *= 0.5;
    }
    return sum;
}
void main() {
    vec2 q = gl_FragCoord.xy / side - 0.5;
    vec2 r = mat2(cos(turn), -sin(turn), sin(turn), cos(turn)) * q * scale;
    float wave = 0.5 + 0.5 * sin(veins * (r.x + warp * fractal(r + 5)));
    vec3 shade = mix(vein, stone, pow(wave, sharpness));
    color = vec4(shade * (1 + 0.6 * light * q.x), 1);
}
"""


class Marble:
    """The shader on a frame in memory; OpenGL stays in the process that made it."""

    def __init__(self) -> None:
        moderngl: Any = import_module("moderngl")
        gl = moderngl.create_context(standalone=True, backend="egl")
        self.program = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        corners = gl.buffer(np.array([-1, -1, 3, -1, -1, 3], np.float32))
        self.quad = gl.vertex_array(self.program, [(corners, "2f", "at")])
        self.frame = gl.simple_framebuffer((SIDE, SIDE), 3)
        self.program["side"] = SIDE

    def __call__(self, p: dict[str, float]) -> NDArray[np.uint8]:
        """Image (SIDE, SIDE, 3)."""
        for name in ("scale", "veins", "warp", "sharpness", "light"):
            self.program[name] = p[name]
        self.program["turn"] = np.radians(p["turn"])
        for name in ("stone", "vein"):
            self.program[name] = p[f"{name}_r"], p[f"{name}_g"], p[f"{name}_b"]
        self.frame.use()
        self.quad.render()
        return np.frombuffer(self.frame.read(), np.uint8).reshape(SIDE, SIDE, 3)[::-1]


class Film:
    """Callback that keeps the best image after each render, later after a twentieth more."""

    def __init__(self, target: NDArray[np.uint8]) -> None:
        self.target, self.frames, self.next = target, list[Image.Image](), 1.0
        self.best: Any = None

    def on_evaluation(self, event: Event) -> None:
        if event.loss == event.best_loss:
            self.best = np.rint(255 * np.asarray(event.image)).astype(np.uint8)
        if event.evaluation + 1 >= self.next and self.best is not None:
            self.next *= 1.05
            pair = np.concatenate([self.target, self.best], axis=1)
            self.frames.append(Image.fromarray(pair).resize((4 * SIDE, 2 * SIDE)))

    def save(self, path: Path) -> None:
        if not self.frames:  # the run was there already
            return
        first, *others = self.frames
        times = [100] * len(others) + [2000]  # ms
        first.save(path, save_all=True, append_images=others, duration=times, loop=0, quality=70)


def main(budget: int) -> None:
    try:
        render = Marble()
    except Exception as error:  # moderngl has no class of its own for a machine without OpenGL
        print(f"no shader here: {error}")
        print("pip install moderngl; apt-get install libegl1 libgl1-mesa-dri")
        return
    target, out = render(TRUTH), Path(f"runs/shader-{budget}")
    film = Film(target)
    how: dict[str, Any] = {"workers": 0, "seed": 0, "out": out, "resume": True}
    result = fit(render, target, SPACE, budget=budget, callbacks=[film], **how)
    print(result)
    for name, true in TRUTH.items():
        print(f"{name:9} {true:>6}  {result.params[name]:.3g}")
    film.save(out / "film.webp")
    print(f"look at {out}/summary.png and {out}/film.webp")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
