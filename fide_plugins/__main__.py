"""Lets ``python -m fide_plugins`` stand for the command ``fide``."""

import sys

from fide_plugins.cli import main

if __name__ == "__main__":
    sys.exit(main())
