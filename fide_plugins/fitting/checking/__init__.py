"""What to know of a renderer before a fit: `fide check`.

============  ==================================================================================
`measuring`   renders a few points, in five steps, and finds the facts
`report`      what they mean: sentences, text for a terminal, data for JSON, a picture
============  ==================================================================================
"""

from fide_plugins.fitting.checking.measuring import Facts, check

__all__ = ["Facts", "check"]
