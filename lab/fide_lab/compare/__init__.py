"""Compare optimizers with the same targets, budgets and seeds.

    >>> from fide_lab.compare import Configuration, Plan
    >>> configurations = Configuration.parse("cma"), Configuration.parse("random")
    >>> plan = Plan(("voronoi",), configurations, seeds=2, budget=100)
    >>> [str(key) for key in plan.runs()][:2]
    ['voronoi mse cma seed 0', 'voronoi mse random seed 0']

`run` executes the missing runs of a plan in a directory, and `read` reads the directory back.
The package `fide_lab.report` reports the results.
"""

from __future__ import annotations

from fide_lab.compare.driver import Outcome, run
from fide_lab.compare.plan import Configuration, Plan, RunKey
from fide_lab.compare.results import Results, StoredRun, read

__all__ = ["Configuration", "Outcome", "Plan", "Results", "RunKey", "StoredRun", "read", "run"]
