"""Each parameter from the tokens that show it: local regressions beside the one of all tokens.

e (n, T, C) and u (n, d) are features and parameters of n candidates, deviations from their weighted
means, times sqrt(w).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from fide_plugins.proposers.feature_buffer import Ridge, explained, ridge
from fide_plugins.types import Float64

_FLOOR = 0.003  # weight of a token that shows nothing
_MOST_WORK = 1e9  # multiplications: tens of milliseconds
_CHANCE = 2.0  # times the share that chance explains
_MOST_TOKENS = 32  # of a parameter, the strongest
_TINY = 1e-300


class Local(NamedTuple):
    """Regressions of single parameters.

    explained: (d,), leave-one-out R^2 of the better one, local or of all tokens.
    coefficients: (n, d), of the scalar products of all tokens alike.
    slopes: (T * C, d), parameters, in units of u, for each feature; added to the former.
    """

    explained: Float64
    coefficients: Float64
    slopes: csc_array


def affordable(n: int, d: int, channels: int) -> bool:
    """Whether d regressions on n candidates, tokens of so many channels, take little time."""
    return d * n**2 * (n + _MOST_TOKENS * channels) <= _MOST_WORK


def local_regressions(
    e: Float64,
    tokens: int,
    u: Float64,
    w: Float64,
    gram: Float64,
    penalty: float,
    rounding: float,
    all_tokens: tuple[Float64, Float64],
) -> Local:
    """Regress each parameter p on the tokens that show it (Fan & Lv 2008, sure screening).

    Its scalar products are G_p = sum_t (v_pt + floor) e_t e_t^T, with the weights of
    `token_weights`; the floor keeps a little of all tokens.  Each parameter takes the regression
    that predicts it better, this one or that on all tokens, by its leave-one-out residuals.

    e: (n, T * C) and u: (n, d), weighted deviations, see above; w: (n,), the weights.
    tokens: T, above 0.  gram: (n, n), e e^T.  penalty, rounding: see `ridge`.
    all_tokens: coefficients (n, d) and leave-one-out R^2 (d,) of the regression on all tokens.
    """
    v, channels = token_weights(e, tokens, u, w), e.shape[1] // tokens
    shown = np.argsort(-v, axis=1, kind="stable")[:, :_MOST_TOKENS]  # (d, m)
    v = np.take_along_axis(v, shown, axis=1)
    features = (shown[:, :, None] * channels + np.arange(channels)).reshape(len(v), -1)  # (d, m C)
    largest = max(float(np.abs(e).max()), _TINY)
    rough = (e / largest).astype(np.float32)  # its errors are far below the penalty
    parts = [
        np.take(rough, f, axis=1) * np.repeat(np.sqrt(one), channels)
        for f, one in zip(features, v, strict=True)
    ]
    grams = largest**2 * np.array([part @ part.T for part in parts], np.float64)
    columns = [
        ridge(one + _FLOOR * gram, column[:, None], penalty, rounding)
        for one, column in zip(grams, u.T, strict=True)
    ]
    fit = Ridge(*(np.column_stack(part) for part in zip(*columns, strict=True)))
    found = explained(u, fit, w)
    better = found > all_tokens[1]
    slopes = [
        largest * (part.T @ alpha) * np.repeat(np.sqrt(one), channels)
        for part, alpha, one in zip(parts, fit.coefficients.T, v, strict=True)
    ]
    ends = np.concatenate([[0], np.cumsum(np.where(better, features.shape[1], 0))])
    entries = np.array(slopes)[better].ravel(), features[better].ravel(), ends
    return Local(
        np.where(better, found, all_tokens[1]),
        np.where(better, _FLOOR * fit.coefficients, all_tokens[0]),
        csc_array(entries, shape=(e.shape[1], len(v))),
    )


def token_weights(e: Float64, tokens: int, u: Float64, w: Float64) -> Float64:
    """Weights v (d, T) of tokens for each parameter, the largest 1.

    The share of a token that the parameter explains alone, beyond what chance explains.
    """
    n, d = u.shape
    u = u / np.maximum(np.abs(u).max(axis=0), _TINY)  # squares would overflow
    products = np.square(u.T @ e).reshape(d, tokens, -1).sum(axis=2)
    energy = np.square(e).reshape(n, tokens, -1).sum(axis=(0, 2))
    share = products / (np.square(u).sum(axis=0)[:, None] * energy + _TINY)
    beyond = np.maximum(share - _CHANCE * np.square(w).sum(), 0.0)  # 1 / n, if all count alike
    weights: Float64 = beyond / np.maximum(beyond.max(axis=1, keepdims=True), 1e-12)
    return weights
