"""A user's own renderer: a function in a file, or any program that writes an image.

    from fide_plugins.renderers import CommandRenderer, FunctionRenderer
    FunctionRenderer("scene.py:render")
    CommandRenderer("povray scene.pov +O{out} Declare=Azimuth={azimuth}", space)

Both are called with a dictionary of parameters and return an image.  Both can be sent to other
processes.

=============  ===================================================================================
file           idea
=============  ===================================================================================
`function`     ``FILE.py:NAME`` or ``module:NAME``: finds the function, and the space beside it
`folder`       the current folder of a user's code, which may change it
`command`      runs a program once for each image
`template`     the command line of a program, with placeholders for parameters
`naming`       parameters by flat names, and as a line of text
`child`        a program that is run to its end, with a time limit and captured output
`scratch`      where the files of one render are while it goes on
=============  ===================================================================================
"""

from fide_plugins.renderers.command import CommandRenderer
from fide_plugins.renderers.function import FunctionRenderer

__all__ = ["CommandRenderer", "FunctionRenderer"]
