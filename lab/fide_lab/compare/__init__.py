"""Compare optimizers with the same targets, budgets and seeds.

    >>> from fide_lab.compare import Configuration, Plan
    >>> configurations = Configuration.parse("cma"), Configuration.parse("random")
    >>> plan = Plan(("voronoi",), configurations, seeds=2, budget=100)
    >>> [str(key) for key in plan.runs()][:2]
    ['voronoi mse cma seed 0', 'voronoi mse random seed 0']

`run` executes the missing runs of a plan in a directory, and `read` reads the directory back.
The package `fide_lab.report` reports the results.

================  ===============================================================
`plan`            tasks x losses x configurations x seeds, checked before the start
`driver`          executes the missing runs of a plan, here, in processes, by Dask
`one_run`         state of one run's directory, and its execution
`directory`       the directory of a comparison, and its record `study.json`
`results`         reads a comparison back
================  ===============================================================
"""

from __future__ import annotations

from fide_lab.compare.driver import run
from fide_lab.compare.one_run import Outcome
from fide_lab.compare.plan import Configuration, Plan, RunKey
from fide_lab.compare.results import Results, StoredRun, read

__all__ = ["Configuration", "Outcome", "Plan", "Results", "RunKey", "StoredRun", "read", "run"]
