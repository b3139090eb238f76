"""The record of candidates, which FIDE and all baselines keep.

`population` says which were drawn, are pending, were evaluated; `candidate` what one of them is.
"""

from __future__ import annotations

from fide_plugins.population.candidate import Candidate, CandidateRole
from fide_plugins.population.population import Population, mirrored_pair, search_columns

__all__ = ["Candidate", "CandidateRole", "Population", "mirrored_pair", "search_columns"]
