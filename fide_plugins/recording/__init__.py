"""What a run records, and its directory: of the runs of the lab, and of `fit`."""
