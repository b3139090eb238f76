"""The report of a comparison: one page, tables, figures.

from fide_lab import compare
from fide_lab import report
report.write(compare.read("runs/first"), "runs/first/report.html")
"""

from fide_lab.report.page import Written, write

__all__ = ["Written", "write"]
