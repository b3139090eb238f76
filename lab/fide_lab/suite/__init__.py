"""A fixed set of problems that any optimizer can enter, and the page of its results.

    fide compare --suite image-fitting-v1 --optimizers fide,cma,mine.py:Search --out runs/suite

============  ====================================================================
`definition`  a suite as data, read from NAME.toml; `scenes/` has its files
`foreign`     scenes whose target another camera or renderer made
`renderers`   what fits them
`problems`    the plan of a comparison that runs them
`scores`      renders to solve each problem, and their data profile
`page`        the page: profile, tables, remarks
============  ====================================================================
"""

from fide_lab.suite.definition import Scene, Suite, names, read

__all__ = ["Scene", "Suite", "names", "read"]
