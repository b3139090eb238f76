"""What is known of a run, in a sentence."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fide_plugins.status import Facts, status_of

RUN = Facts(evaluations=3000, best=0.01, improved_at=1200, horizon=500, ended=[2, 1, 1])


@pytest.mark.parametrize(
    ("facts", "code", "says"),
    [
        (replace(RUN, best=None), "waiting", "finite loss"),
        (replace(RUN, solved=True), "solved", "0.01"),
        (replace(RUN, noise=0.02), "noise", "samples per pixel"),
        (replace(RUN, improved_at=2800), "improving", "Still improving"),
        (replace(RUN, ended=[]), "stalled", "since evaluation 1,200"),
        (replace(RUN, ended=[1]), "stalled", "since evaluation 1,200"),
        (RUN, "unsure", "4 searches ended in 3 different places, 2 in the best"),
        (replace(RUN, ended=[5, 1]), "agreed", "5 of 6 searches ended in this place"),
        (replace(RUN, ended=[2]), "unsure", "2 of 2 searches ended in this place, too few"),
        (replace(RUN, ended=[3, 3]), "unsure", "2 different places"),
        (replace(RUN, noise=1e-4), "unsure", "0.01"),
        (replace(RUN, best=-1.0, noise=0.1), "unsure", "loss -1"),
    ],
)
def test_what_is_known(facts: Facts, code: str, says: str) -> None:
    status = status_of(facts)
    assert status.code == code and says in status.sentence and str(status) == status.sentence
