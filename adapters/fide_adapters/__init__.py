"""FIDE inside other optimization frameworks.

Each adapter is a module of its own that imports its framework only when it is itself imported;
this package imports nothing.
"""
