"""The record of candidates, which FIDE and all baselines keep."""

from __future__ import annotations

from fide_plugins.population.candidate import Candidate, CandidateRole
from fide_plugins.population.population import Population, mirrored_pair, search_columns

__all__ = ["Candidate", "CandidateRole", "Population", "mirrored_pair", "search_columns"]
