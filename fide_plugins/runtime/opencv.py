"""OpenCV; or an error that says what to do where its installation is broken.

Four distributions install the same folder `cv2`: to uninstall one of them breaks the others.
"""

from __future__ import annotations

from fide_plugins.errors import DependencyError
from fide_plugins.runtime.machine import opencv_remedy

try:
    import cv2 as cv2
except ImportError as error:  # also a library of the system that is missing, such as libGL
    raise DependencyError(f"OpenCV cannot be imported ({error}): {opencv_remedy()}") from error
