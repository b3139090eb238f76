"""Checks and conversions of user input.

=============  ====================================================================
`images`       targets and renders, see the rules in its docstring
`pixels`       rules of types, axes and values, value range and clipping
`image_files`  files and PIL images, read, written, reduced
`tensors`      renders that stay on their GPU; features that were encoded elsewhere
`points`       candidates, numbers, seeds, standard deviations
`options`      rules for the values of options; ``key=value`` on the command line
=============  ====================================================================
"""
