"""FIDE inside other optimization frameworks, and a server for agents.

Each adapter is a module of its own that imports its framework only when it is itself imported;
this package imports nothing.
"""

COMMANDS = {"mcp": "serve agents, by the Model Context Protocol"}
"""Commands that `fide` finds here."""
