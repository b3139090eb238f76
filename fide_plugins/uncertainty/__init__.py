"""How sure the parameters of a solution are: a standard deviation for each.

By renders around the answer at the end of a fit (`at_answer`), elsewhere by samples of the search.
"""

from __future__ import annotations

from fide_plugins.uncertainty.estimate import LocalEstimate

__all__ = ["LocalEstimate"]
