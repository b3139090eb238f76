"""Checks and conversions of user input.

===============  ==============================================
`images`         targets and renders
`image_sources`  pixels of an array or a torch tensor
`image_files`    files and PIL images, read and written
`exr`            OpenEXR files
`reduction`      pictures made smaller
`unit_range`     values become floats in [0, 1]
`value_range`    which values are black and white
`clipping`       renders beyond them: an overshoot, or another scale
`tensors`        renders that stay on their GPU
`rules`          rules of axes and values for both
`points`         candidates, seeds, standard deviations
`features`       tokens that were encoded elsewhere
`option_rules`   rules for the values of options
`key_value`      ``key=value`` on the command line
===============  ==============================================
"""
