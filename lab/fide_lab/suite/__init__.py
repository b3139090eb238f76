"""A fixed set of problems that any optimizer can enter, and the page of its results.

fide compare --suite image-fitting-v1 --optimizers fide,cma,mine.py:Search --out runs/suite
"""

from fide_lab.suite.definition import Scene, Suite, names, read

__all__ = ["Scene", "Suite", "names", "read"]
