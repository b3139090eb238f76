"""Loss and encoder of several views, or of the pixels that count."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from fide_plugins import losses
from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.own import OwnEncoder, check_encoder
from fide_plugins.errors import LossError, OptionError
from fide_plugins.losses.base import (
    CallableLoss,
    ImageLoss,
    LossOfTarget,
    as_losses,
    check_loss,
    loss_not_stored,
)
from fide_plugins.runtime.registry import name_of
from fide_plugins.runtime.threads import user_threads
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.pixels import warn_clipped
from fide_plugins.views.views import View, Views


def loss_of(
    views: Views,
    loss: str | Callable[..., object] | None,
    *,
    device: str | torch.device | None = None,
) -> ImageLoss:
    """Loss from a name, None for "mse", a callable, or a loss of one view that was made.

    A user's own is tried on the target first.  Raises as `losses.resolve`, and LossError for a made
    loss where there are several views.
    """
    if isinstance(loss, LossOfViews):
        return loss
    if views.plain:
        made = losses.resolve(loss, views.target, device=device)
        if isinstance(made, CallableLoss) and made is not loss and loss is not loss_not_stored:
            check_loss(made, views.target)
        return made
    if loss is None or isinstance(loss, str):
        name = loss or "mse"
        return LossOfViews(views, [_of_view(name, view, device) for view in views.views], name)
    if isinstance(loss, LossOfTarget | CallableLoss):
        if views.listed:
            raise LossError(
                f"the loss {loss.name!r} was made for one target, and there are "
                f"{len(views.views)} views; pass its name, or a function of a list of batches"
            )
        made = losses.resolve(loss, views.target)
        spec = made.spec  # by which a checkpoint makes it again
        one = made if spec is None else _of_view(spec, views.views[0], device)
        return LossOfViews(views, [one], spec)
    if not callable(loss):
        return losses.resolve(loss, views.target)  # raises
    several = CallableOfViews(views, loss)
    if loss is not loss_not_stored:
        check_loss(several, views.target)
    return several


def _of_view(name: str, view: View, device: str | torch.device | None) -> ImageLoss:
    """Loss of one view: with its weights, if it takes them."""
    if view.weights is not None and losses.takes_weights(name):
        return losses.make(name, view.filled, weights=view.weights)
    made = losses.resolve(name, view.filled, device=device)
    if isinstance(made, CallableLoss):
        check_loss(made, view.filled)
    return made


class LossOfViews:
    """Mean of the views' losses, each divided by the mean of its weights.

    each: loss of each view, in order, of `View.filled`.  One that knows the weights is not divided.
    spec: its name; None: a user's own, which was made for the target as it was given.
    """

    def __init__(self, views: Views, each: list[ImageLoss], spec: str | None) -> None:
        self.views, self._each, self.spec = views, each, spec
        self.name, version = each[0].name, each[0].version
        self.version = None if version is None else version + views.version
        self.of_places = all(getattr(one, "of_places", True) for one in each)

    def __call__(self, images: object) -> Float64:
        """Losses (n,) of images, as `FIDE.tell` takes them."""
        return self.compute(self.views.as_batch(images, None, warn_clipped))

    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of packed renders, without further checks."""
        parts = zip(self.views.views, self._each, self.views.split(batch), strict=True)
        return np.asarray(np.mean([self._of_view(*part) for part in parts], axis=0))

    def _of_view(self, view: View, loss: ImageLoss, part: Float32) -> Float64:
        knows_weights = getattr(loss, "weights", None) is not None
        if view.weights is None or (getattr(loss, "weighs_pixels", False) and knows_weights):
            return loss.compute(part)
        shown = view.blended(part) if self.spec is None else view.shown(part)
        values: Float64 = loss.compute(shown) / view.mean_weight
        return values


class CallableOfViews(LossOfViews):
    """A user's function of what is seen of the views, with checks of its values."""

    version = None
    spec = None

    def __init__(self, views: Views, function: Callable[..., object]) -> None:
        self.views, self.name, self._function = views, name_of(function), function

    @user_threads
    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of packed renders; the function gets copies, which it may modify."""
        pairs = zip(self.views.views, self.views.split(batch), strict=True)
        shown = [view.blended(part).copy() for view, part in pairs]
        values = self._function(shown if self.views.listed else shown[0])
        return as_losses(values, len(batch), f"the loss {self.name!r}")


# -- the encoder -----------------------------------------------------------------------------------


def encoder_of(views: Views, encoder: PatchEncoder) -> PatchEncoder:
    """The encoder of views; the encoder itself for one view without weights.

    A user's own is tried on the targets; raises FeaturesError.
    """
    base = encoder.base if isinstance(encoder, EncoderOfViews) else encoder
    for view in views.views:
        if isinstance(base, OwnEncoder):
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
