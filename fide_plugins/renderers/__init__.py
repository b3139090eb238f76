"""A user's own renderer: a function in a file, or any program that writes an image.

    from fide_plugins.renderers import CommandRenderer, FunctionRenderer
    FunctionRenderer("scene.py:render")
    CommandRenderer("povray scene.pov +O{out} Declare=Azimuth={azimuth}", space)

Both are called with a dictionary of parameters and return an image.  Both can be sent to other
processes.

=============  ===================================================================================
`function`     ``FILE.py:NAME`` or ``module:NAME``: finds the function, and the space beside it
`command`      runs a program once for each image; its command line with placeholders
`child`        a program that is run to its end, with a time limit and captured output
`naming`       parameters by flat names, and as a line of text
=============  ===================================================================================
"""

from fide_plugins.renderers.command import CommandRenderer
from fide_plugins.renderers.function import FunctionRenderer

__all__ = ["CommandRenderer", "FunctionRenderer"]
