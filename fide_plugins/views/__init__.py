"""Several views of one scene, masks and weights of pixels, values beyond [0, 1].

Let t be the target, x a render, w the weights, (H, W), of which the largest is 1.  Loss and encoder
get x' = t + sqrt(w) (x - t), and the loss is divided by the mean of w.  Before that the pixels of
weight 0 of the target get the mean color of all others; only a user's own loss gets its own.
"""

from __future__ import annotations

from fide_plugins.views.views import View, Views, is_list_of_images

__all__ = ["View", "Views", "is_list_of_images"]
