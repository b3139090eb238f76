"""The machine: devices, threads, files, and what users name or hand over."""
