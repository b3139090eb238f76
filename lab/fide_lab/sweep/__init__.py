"""Speed against accuracy: sweep options of optimizer and task, and recommend a combination.

=========  ===================================================================
`grid`     all combinations of the swept options, as comparisons
`front`    reads the results back; losses for a given cost; the Pareto front
`tables`   writes tables and figures, and recommends a combination
=========  ===================================================================
"""

from __future__ import annotations

from fide_lab.sweep.front import Combination, best_within, front, read
from fide_lab.sweep.grid import Grid

__all__ = ["Combination", "Grid", "best_within", "front", "read"]
