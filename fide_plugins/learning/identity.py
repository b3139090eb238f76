"""Whether what renders now is what rendered before: the version that it states."""

from __future__ import annotations

from fide_plugins.errors import OptionError
from fide_plugins.learning.renderer import Renderer
from fide_plugins.renderers.fingerprint import check_version, version_of

__all__ = ["version_for"]


def version_for(renderer: Renderer, version: str | None) -> str | None:
    """Version that was given, or else the one that the renderer states.

    Raises OptionError unless both are the same text, where there are both.
    """
    given = check_version(version, "version")
    own = version_of(renderer.source)
    if given is not None and own is not None and given != own:
        raise OptionError(
            f"version is {given!r}, and the renderer {renderer.name} states {own!r}: leave out "
            "version, or change that of the renderer"
        )
    return own if given is None else given
