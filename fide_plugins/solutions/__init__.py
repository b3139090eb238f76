"""Distinct candidates of a run, best first, side by side: as a table and as a picture.

=============  =========================================================================
`found`        reads them from a run directory; nothing in it is executed
`pictures`     images of candidates, kept in the run directory
`words`        values of parameters in their units, and how sure they are
`figure`       the picture
=============  =========================================================================
"""

from __future__ import annotations

from fide_plugins.solutions.figure import figure
from fide_plugins.solutions.found import Found, read
from fide_plugins.solutions.words import Row, rows

__all__ = ["Found", "Row", "figure", "read", "rows"]
