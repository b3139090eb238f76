"""Options that make each baseline quick; the tests and `benchmarks/golden.py` use them."""

from __future__ import annotations

from typing import Any

OPTIONS: dict[str, dict[str, Any]] = {
    "cma": {},
    "dfols": {},
    "dibo": {
        "popsize": 20,
        "initial": 40,
        "buffer": 40,
        "proxy_epochs": 1,
        "prior_epochs": 1,
        "posterior_epochs": 2,
        "search_epochs": 1,
        "proposals": 1,
        "diffusion_steps": 3,
        "width": 8,
        "proxy_width": 8,
        "batch": 16,
        "precision": "single",
    },
    "diffusion-evolution": {"popsize": 16, "budget": 80},
    "dual-annealing": {},
    "eki": {"popsize": 20},
    "fide-annealing": {"samples": 20, "epochs": 1},
    "inverse": {"popsize": 20, "budget": 100, "share": 0.4, "epochs": 2, "width": 8, "blocks": 1},
    "random": {},
    "sge": {"popsize": 2},
    "zerograds": {"popsize": 9},
}
