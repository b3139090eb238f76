"""How many candidates proposers remember, and learn from at once."""

from __future__ import annotations

__all__ = ["MOST", "for_jacobian"]

MOST = 600
"""Candidates: each generation costs a regression on as many."""


def for_jacobian(dim: int) -> int:
    """Candidates to which a Jacobian of d parameters is fitted: 4 d + 20, at most `MOST`.

    >>> for_jacobian(8), for_jacobian(200)
    (52, 600)
    """
    return min(4 * dim + 20, MOST)
