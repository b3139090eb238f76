"""Keyword arguments of a renderer that are no parameters: how fine an image is to be."""

from __future__ import annotations

from collections.abc import Callable
from inspect import Parameter, signature
from typing import Any

DEFAULTS: dict[str, Any] = {"size": (128, 128), "samples": 16, "seed": 0}
"""Outside of a fit, where the renderer has no default of its own."""
KEYWORDS = tuple(DEFAULTS)


def missing_from(keywords: dict[str, Any]) -> dict[str, Any]:
    """`DEFAULTS` of the keywords, as `keywords_of` has them, that have no default."""
    return {name: DEFAULTS[name] for name, one in keywords.items() if one is Parameter.empty}


def keywords_of(render: Callable[..., Any], *, declared: bool = False) -> dict[str, Any]:
    """Which of `KEYWORDS` a renderer takes, with their defaults; `Parameter.empty` without one.

    A renderer of ours says so by its attribute `keywords`; of any other function its signature
    does.  A `size` whose default is one number takes no (h, w).

    declared: whether the user says that it takes them: also as ``**keywords``, and any size.
    """
    own = getattr(render, "keywords", None)
    if isinstance(own, dict):
        return own
    try:
        parameters = list(signature(render, follow_wrapped=False).parameters.values())
    except (TypeError, ValueError):  # of some functions of C nobody knows it
        return {}
    named = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    found = {p.name: p.default for p in parameters[1:] if p.kind in named and p.name in KEYWORDS}
    if declared and any(p.kind is Parameter.VAR_KEYWORD for p in parameters):
        found = dict.fromkeys(KEYWORDS, Parameter.empty) | found
    if not declared and isinstance(found.get("size"), int | float):
        del found["size"]
    return found
