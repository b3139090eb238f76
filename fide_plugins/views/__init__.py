"""Several views of one scene, masks and weights of pixels.

    opt = FIDE(space, target=[front, side], mask=[None, "side-mask.png"])
    opt.tell(X, [fronts, sides])       # (n, H, W, C) each, of that view's size

**Views.**  A target that is a list has one entry for each view; sizes may differ.  Renders are then
a list of batches, one for each view, in the same order.  The loss is the mean of the views' losses:
a view of many pixels counts as much as one of few.  The tokens of all views are joined along T.

**Weights.**  `mask` and `weights` are pictures (H, W) in [0, 1]; where both are given they are
multiplied.  Only ratios within a view count: the largest weight becomes 1.  Let t be the target, x
a render, w the weights.  Loss and encoder get

    x' = t + sqrt(w) (x - t),

so a pixel of weight 0 is that of the target and costs nothing, and the squared difference of any
other is w (x - t)^2.  Before that the pixels of weight 0 of the target itself get the mean color of
all others, to the nearest eighth in each channel: what it has there has no influence.  Only a
user's own loss, which may know the target, gets x' with the target's own pixels.  The loss of x' is
divided by the mean of w: `mse` is sum w (x - t)^2 / sum w, and does not depend on how much is
hidden.  The other losses do, since no division is exact for them: `perceptual` sees the contour of
the mask where x differs from t, and `loi`, whose distances are not squares, counts by sqrt(w).
Compare their values under one mask only.  With x 0.6 and t 0.5 everywhere, 96 x 96 pixels:

====================================  =====  =====  ==========
w                                     mse    loi    perceptual
====================================  =====  =====  ==========
1                                     0.01   0.100  0.040
1 in the left half, else 0            0.01   0.100  0.311
1 in 10 x 10 pixels, else 0           0.01   0.115  1.086
1 in 10 x 10 pixels, else 0.01        0.01   0.536  0.496
====================================  =====  =====  ==========

A callable loss gets x' and is not divided; one that is registered is, by its name.

One view without weights is not changed in any way.

**Values.**  With `value_range=(low, high)` images hold any numbers, of any type: they are mapped to
[0, 1] before anything else, (v - low) / (high - low), and `best.image` is mapped back.  Losses and
features are of the mapped values.  "auto" is the range of what the target shows, with half of its
span beyond both ends, but without negative values if the target has none.  It is fixed by the first
target, and stays for the next ones.

==============  ==================================================================
`views`         all views of a scene; several pictures packed as one
`view`          target and weights of one view
`given`         targets, masks and weights as a user gives them
`weights`       reads masks and weights
`loss`          the loss of views
`encoder`       the tokens of views
`same_images`   notices a renderer that does not use its parameters
`grain`         whether an image differs from the target by noise of its pixels alone
`solved`        whether it equals the target but for what no eye sees
==============  ==================================================================
"""

from __future__ import annotations

from fide_plugins.views.given import is_list_of_images
from fide_plugins.views.view import View
from fide_plugins.views.views import Views

__all__ = ["View", "Views", "is_list_of_images"]
