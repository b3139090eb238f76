"""The report of a comparison: one page, tables, figures.

    from fide_lab import compare
    from fide_lab import report
    report.write(compare.read("runs/first"), "runs/first/report.html")

============  ====================================================================
`statistics`  quantiles, bands and paired tests
`panel`       the results for one task and one loss
`tables`      tables of a panel, and CSV files
`sentences`   the results of a panel in sentences, and the method
`plots`       charts and pictures, as matplotlib figures
`document`    any report as one HTML page, in Markdown, and its pictures
`page`        the report of a comparison
============  ====================================================================
"""

from fide_lab.report.page import Written, write

__all__ = ["Written", "write"]
