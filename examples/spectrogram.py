"""Find the settings of a synthesizer from a sound, seen as a spectrogram.

    python examples/spectrogram.py          # a short run
    python examples/spectrogram.py 3000     # the run of the gallery

A tone whose frequency is modulated, with a glide, an envelope, a low-pass filter and breath noise.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import ShortTimeFFT

from fide_plugins import Float, Space, fit

RATE, SECONDS = 8000, 1.0  # samples a second
SPACE = Space(
    pitch=Float(200, 400, unit="Hz", log=True), glide=Float(-12, 12, unit="semitones"),
    ratio=Float(0.5, 4), index=Float(0, 6), attack=Float(0.01, 0.5, unit="s", log=True),
    decay=Float(0.1, 2, unit="s", log=True), cutoff=Float(500, 4000, unit="Hz", log=True),
    breath=Float(0.001, 0.2, log=True),
)  # fmt: skip
TRUTH = {
    "pitch": 280.0, "glide": 5.0, "ratio": 1.5, "index": 2.5, "attack": 0.08, "decay": 0.6,
    "cutoff": 2500.0, "breath": 0.02,
}  # fmt: skip
T = np.arange(int(RATE * SECONDS)) / RATE
WINDOW = np.hanning(252)
STFT = ShortTimeFFT(WINDOW, hop=len(T) // 100, fs=RATE, scale_to="magnitude")
NOISE = np.random.default_rng(0).standard_normal(len(T))  # the same breath each time


def sound(p: dict[str, float]) -> NDArray[np.float64]:
    """One second, float in about [-1, 1]."""
    pitch = p["pitch"] * 2 ** (p["glide"] * T / 12)
    phase = 2 * np.pi * np.cumsum(pitch) / RATE
    wave = np.sin(phase + p["index"] * np.sin(p["ratio"] * phase)) + p["breath"] * NOISE
    envelope = np.minimum(T / p["attack"], 1) * np.exp(-T / p["decay"])
    return np.asarray(envelope * wave)


def render(p: dict[str, Any]) -> NDArray[np.float64]:
    """Spectrogram (127, ~100), 60 dB in [0, 1]; low frequencies at the bottom."""
    spectrum = np.abs(STFT.stft(sound(p), k_offset=0))  # (frequencies, times)
    spectrum /= np.sqrt(1 + (STFT.f[:, None] / p["cutoff"]) ** 8)
    decibels = 20 * np.log10(spectrum + 1e-9)
    image: NDArray[np.float64] = np.clip(1 + decibels / 60, 0, 1)[::-1]
    return image


def main(budget: int) -> None:
    out = f"runs/spectrogram-{budget}"
    result = fit(
        render, render(TRUTH), SPACE, budget=budget, workers=0, out=out, resume=True, seed=0
    )
    print(result)
    for name, true in TRUTH.items():
        print(f"{name:8} {true:>8}  {result.params[name]:.4g}")
    print(f"look at {out}/summary.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
