"""The tokens of several views, or of the pixels that count."""

from __future__ import annotations

import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.own import check_encoder
from fide_plugins.errors import OptionError
from fide_plugins.types import Float32
from fide_plugins.views.views import Views

__all__ = ["EncoderOfViews", "encoder_of"]


def encoder_of(views: Views, encoder: PatchEncoder) -> PatchEncoder:
    """The encoder of views; the encoder itself for one view without weights.

    A user's own is tried on the targets; raises FeaturesError.
    """
    base = encoder.base if isinstance(encoder, EncoderOfViews) else encoder
    for view in views.views:
        check_encoder(base, view.target)
    return base if views.plain else EncoderOfViews(views, base)


class EncoderOfViews(PatchEncoder):
    """Joins the tokens of all views along T: (n, T_1 + T_2 + ..., C).

    base: encodes the pictures of each view, with the target's pixels where they do not count.

    Raises OptionError if the encoder has another C for one of the views.
    """

    def __init__(self, views: Views, base: PatchEncoder) -> None:
        self.views, self.base = views, base
        self.version = base.version + views.version
        for name in ("name", "uses_network", "weights_digest", "channel_subsets", "device"):
            setattr(self, name, getattr(base, name))
        shapes = [base.shape(*view.size) for view in views.views]
        if len({channels for _, channels in shapes}) > 1:
            raise OptionError(
                f"the encoder {base.name!r} gives tokens of different lengths C for the views, "
                f"(T, C) = {shapes}; take one whose C does not depend on the size"
            )
        self._shape = sum(tokens for tokens, _ in shapes), shapes[0][1]

    def __call__(self, images: object) -> torch.Tensor:
        """Tokens (n, T, C) of renders, as `FIDE.tell` takes them; raises ImageError."""
        return self.compute(self.views.as_batch(images, None, lambda message: None))

    def compute(self, batch: Float32) -> torch.Tensor:
        """Tokens (n, T, C) of packed renders (n, P, 1, 3), without further checks."""
        pairs = zip(self.views.views, self.views.split(batch), strict=True)
        return torch.cat([self.base.compute(view.shown(part)) for view, part in pairs], dim=1)

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) of all views together, whose sizes are known."""
        return self._shape

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        raise AssertionError("`compute` encodes each view by the base")
