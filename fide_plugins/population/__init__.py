"""The record of candidates, which FIDE and all baselines keep.

=================  =======================================================
`population`       which were drawn, which are pending, which were evaluated
`candidate`        one of them
`training_sample`  one whose image is known
`best`             the best point told so far
=================  =======================================================
"""

from __future__ import annotations

from fide_plugins.population.candidate import Candidate
from fide_plugins.population.population import (
    Population,
    Propose,
    mirrored_pair,
    search_columns,
)

__all__ = ["Candidate", "Population", "Propose", "mirrored_pair", "search_columns"]
