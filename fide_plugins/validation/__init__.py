"""Checks and conversions of user input.

===============  ==============================================
`images`         targets and renders
`image_sources`  pixels of a path, a PIL image or a torch tensor
`tensors`        renders that stay on their GPU
`rules`          rules of axes and values for both
`points`         candidates, seeds, standard deviations
`features`       tokens that were encoded elsewhere
`option_rules`   rules for the values of options
`key_value`      ``key=value`` on the command line
===============  ==============================================
"""
