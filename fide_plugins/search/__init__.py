"""Search: a distribution that is refined from generation to generation, and where it begins."""
