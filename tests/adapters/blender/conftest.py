"""`headless.py` runs in Blender."""

collect_ignore = ["headless.py"]
