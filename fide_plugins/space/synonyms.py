"""Words that other libraries and users have for what a parameter is given."""

from __future__ import annotations

from collections.abc import Iterable

from fide_plugins.errors import did_you_mean

__all__ = ["is_synonym", "right_word"]

_SYNONYMS = {
    "low": ("min", "minimum", "lower", "lower_bound", "lo", "start", "from"),
    "high": ("max", "maximum", "upper", "upper_bound", "hi", "stop", "end", "to"),
    "unit": ("units",),
    "log": ("logarithmic", "log_scale", "logscale", "logspace"),
    "periodic": ("wrap", "wraps", "wrapped", "cyclic", "circular", "angle"),
    "step": ("steps", "stride", "increment", "spacing", "q"),
    "values": ("value", "choices", "options", "categories", "items"),
}
_OF = {synonym: word for word, synonyms in _SYNONYMS.items() for synonym in synonyms}


def is_synonym(name: str) -> bool:
    """Whether a key is another word for something that a parameter has."""
    return name.lower() in _OF


def right_word(name: object, known: Iterable[str]) -> str:
    """End of a message about a name that is not known: the word that is meant, if that is clear.

    >>> right_word("units", ["low", "unit"]), right_word("hihg", ["high"]), right_word("x", ["low"])
    ("; did you mean 'unit'?", "; did you mean 'high'?", '')
    """
    words = list(known)
    word = _OF.get(str(name).lower())
    return f"; did you mean {word!r}?" if word in words else did_you_mean(name, words)
