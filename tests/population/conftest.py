"""Populations, and what is drawn for them."""

from __future__ import annotations

import numpy as np

from fide_plugins.population import Population
from fide_plugins.types import Float64

PROPOSED = 2  # of each generation, the last ones


def drawn(popsize: int, seed: int = 0, population: Population | None = None) -> Population:
    population = population or Population()
    x = np.random.default_rng(seed).random((popsize, 2))
    n = popsize - PROPOSED
    population.draw(x[:n], x[:n] + 2.0, x[n:])
    return population


def reloaded(population: Population, dim: int) -> Population:
    """A copy, by way of a state."""
    copy = Population()
    copy.load_state_dict(population.state_dict(), {"d": dim})
    return copy


def index_of(population: Population, x: Float64, loss: float) -> int | None:
    """Enter a result; the index of its candidate, None if it is injected."""
    candidate = population.record(x, loss)
    return None if candidate is None else candidate.index


def hand_out(population: Population, n: int) -> list[Float64]:
    """The next n candidates; proposals are made when the first of them is asked for."""
    if n > len(population.queue) and len(population.reserved):
        population.add_proposals(population.reserved, population.reserved + 2.0)
    return [population.hand_out().x for _ in range(n)]
