"""The record of candidates, which FIDE and all baselines keep.

=================  =======================================================
`population`       which were drawn, which are pending, which were evaluated
`queue`            those that were drawn and not handed out
`pending`          those that were handed out and not told
`candidate`        one of them, and what it counts for
`training_sample`  one whose image is known
`best`             the best point told so far
=================  =======================================================
"""

from __future__ import annotations

from fide_plugins.population.candidate import Candidate, CandidateRole
from fide_plugins.population.population import Population, mirrored_pair, search_columns
from fide_plugins.population.queue import Propose

__all__ = ["Candidate", "CandidateRole", "Population", "Propose", "mirrored_pair", "search_columns"]
