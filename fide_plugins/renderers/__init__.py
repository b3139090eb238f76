"""A user's own renderer: a function in a file, or any program that writes an image.

Both are called with a dictionary of parameters and return an image.
"""

from fide_plugins.renderers.command import CommandRenderer
from fide_plugins.renderers.function import FunctionRenderer

__all__ = ["CommandRenderer", "FunctionRenderer"]
