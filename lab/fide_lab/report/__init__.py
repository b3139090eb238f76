"""The report of a comparison: one page, tables, figures.

    from fide_lab import compare
    from fide_lab import report
    report.write(compare.read("runs/first"), "runs/first/report.html")

============  ====================================================================
`statistics`  quantiles, bands, paired tests and success rates
`panel`       the results for one task and one loss
`tables`      tables of a panel, and CSV files
`sentences`   the results of a panel in sentences, and the method
`plots`       charts and pictures, as matplotlib figures, files and SVG elements
`page`        the report: one HTML file, made from `templates/`, and what goes with it
============  ====================================================================
"""

<<<<<<< HEAD
from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from fide_lab.compare.plan import as_file_name, target_file
from fide_lab.compare.results import (
    AXES,
    AllFailedError,
    NoResultsError,
    Results,
)
from fide_lab.report import export, pictures, plots, sentences, svg, tables
from fide_lab.report.panel import Panel, check_thresholds, panels
from fide_plugins.errors import OptionError
from fide_plugins.runtime import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure
=======
from fide_lab.report.page import Written, write
>>>>>>> main

__all__ = ["Written", "write"]
