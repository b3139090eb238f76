"""Distinct candidates of a run, best first, side by side: as a table and as a picture.

=============  =========================================================================
`found`        reads them from a run directory; nothing in it is executed
`pictures`     images of candidates, kept in the run directory
`figure`       the picture
=============  =========================================================================
"""

from __future__ import annotations

from fide_plugins.solutions.figure import figure
from fide_plugins.solutions.found import Found, read

__all__ = ["Found", "figure", "read"]
