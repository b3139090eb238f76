"""Which head learns a space, which of its axes are exchangeable blocks, and what they allow."""

from __future__ import annotations

from collections.abc import Sequence

from fide_plugins.errors import OptionError
from fide_plugins.learning.renders.renderer import BatchRenderer

__all__ = ["has_emulator", "kind_of"]


def kind_of(
    renderer: BatchRenderer, groups: Sequence[Sequence[int]] | None, head: str | None
) -> tuple[str, tuple[tuple[int, ...], ...]]:
    """Head and exchangeable blocks.

    groups: blocks of axes; empty: nothing is exchangeable; None: the largest family of the space.
    head: name in `network.HEADS`; None: "set" where there are blocks, "autoregressive" elsewhere.

    Raises OptionError for groups that are not blocks or not alike, and for the head "set" without
    blocks.
    """
    from fide_plugins.search.exchangeability import check_groups

    if groups is None:
        groups = [] if renderer.space is None else renderer.space.largest_family
    elif not (hasattr(groups, "__len__") and len(groups) == 0):
        groups = check_groups(groups, renderer.dim).tolist()
        _check_alike(groups, renderer.periodic)
    if head == "set" and len(groups) == 0:
        raise OptionError("the head 'set' needs exchangeable blocks: give groups, or another head")
    blocks = tuple(tuple(int(i) for i in block) for block in groups)
    head = head or ("set" if blocks else "autoregressive")
    return head, blocks


def _check_alike(blocks: Sequence[Sequence[int]], periodic: Sequence[bool]) -> None:
    """Raise OptionError if an axis is periodic in one block, and its like in another is not."""
    for one, *others in zip(*blocks, strict=True):
        for other in others:
            if periodic[one] != periodic[other]:
                around, straight = (one, other) if periodic[one] else (other, one)
                raise OptionError(
                    f"groups must be alike: parameter {around} is periodic, and {straight}, which "
                    "has its place in another group, is not"
                )


def has_emulator(emulator: bool | None, blocks: Sequence[Sequence[int]]) -> bool:
    """Whether a learned renderer is trained; None: where there are exchangeable blocks.

    Raises OptionError for what is no bool or None, and for an emulator without blocks.
    """
    if not (emulator is None or isinstance(emulator, bool)):
        raise OptionError(f"emulator is True, False or None, not {emulator!r}")
    if emulator and not blocks:
        raise OptionError(
            "an emulator needs exchangeable blocks: give groups, or leave out emulator"
        )
    return bool(blocks) if emulator is None else emulator
