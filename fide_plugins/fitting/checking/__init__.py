"""What to know of a renderer before a fit: `fide check`.

============  ==================================================================================
`values`      points at which one parameter has its low, middle and high value
`pixels`      one image: its views as arrays, their range and type, differences
`facts`       what is found
`rendering`   renders, in five steps, and finds it
`advice`      what it means for a fit, in sentences
`report`      text for a terminal, and data for JSON
`figure`      the picture: one row a parameter
============  ==================================================================================
"""

from __future__ import annotations

from fide_plugins.fitting.checking.facts import Facts
from fide_plugins.fitting.checking.rendering import check

__all__ = ["Facts", "check"]
