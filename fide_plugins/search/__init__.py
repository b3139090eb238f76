"""Search distributions: what is refined from generation to generation (Sec. 3.3)."""
