"""Several views of one scene, masks and weights of pixels, values beyond [0, 1].

    opt = FIDE(space, target=[front, side], mask=[None, "side-mask.png"])
    opt.tell(X, [fronts, sides])       # (n, H, W, C) each, of that view's size

A target that is a list has one entry for each view; the loss is the mean of the views' losses, the
tokens of all views are joined.  `mask` and `weights`, (H, W) in [0, 1], are multiplied; the largest
becomes 1.  Let t be the target, x a render, w the weights.  Loss and encoder get

    x' = t + sqrt(w) (x - t),

so the squared difference of a pixel is w (x - t)^2.  Before that the pixels of weight 0 of the
target get the mean color of all others, to the nearest eighth; only a user's own loss gets the
target's own.  The loss of x' is divided by the mean of w: `mse` is sum w (x - t)^2 / sum w.

With `value_range=(low, high)` images are mapped to [0, 1] before anything else.  "auto" is the
range of what the first target shows, with half of its span beyond both ends, but not below 0 if it
is not.
"""

from __future__ import annotations

from fide_plugins.views.views import View, Views, is_list_of_images

__all__ = ["View", "Views", "is_list_of_images"]
