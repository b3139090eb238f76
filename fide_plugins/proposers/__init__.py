"""Proposers: what an image says about where the next candidates should lie."""
