"""A fixed set of problems that any optimizer can enter, and the page of its results.

    fide compare --suite image-fitting-v1 --optimizers fide,cma,mine.py:Search --out runs/suite

============  ====================================================================
`definition`  a suite as data, read from NAME.toml; `scenes/` has its files
`problems`    the plan of a comparison that runs them
`profiles`    data profiles and performance profiles
`scores`      renders to solve each problem, of a comparison's results
`remarks`     what is said of failed runs and of what is left out
`figures`     both profiles, drawn
`tables`      counts of solved problems and of lowest losses
`page`        the page
============  ====================================================================
"""

from fide_lab.suite.definition import Scene, Suite, names, read

__all__ = ["Scene", "Suite", "names", "read"]
