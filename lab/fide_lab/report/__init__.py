"""The report of a comparison: one page, and a table of all runs.

from fide_lab import compare
from fide_lab import report
report.write(compare.read("runs/first"), "runs/first/report.html")
"""

from fide_lab.report.document import Written
from fide_lab.report.page import write

__all__ = ["Written", "write"]
