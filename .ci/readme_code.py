"""Runs the Python of README as it stands: `python readme_code.py README.md [NUMBER OF BLOCKS]`."""

import logging
import re
import sys
from pathlib import Path

if __name__ == "__main__":
    blocks = re.findall(r"```python\n(.*?)```", Path(sys.argv[1]).read_text("utf-8"), re.DOTALL)
    count = int(sys.argv[2]) if len(sys.argv) > 2 else len(blocks)
    assert blocks, "README shows no Python"
    logging.disable(logging.INFO)  # of each trial
    names: dict[str, object] = {"__name__": "__main__"}
    for block in blocks[:count]:
        exec(compile(block, sys.argv[1], "exec"), names)
    print(f"README: {count} of {len(blocks)} pieces of Python ran")
