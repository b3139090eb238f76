"""The page of the command line, made from the parsers of `fide` themselves.

    .. command-line::

in a page of reStructuredText stands for one section a command.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

from fide_plugins.cli import commands, module_of


def setup(app: Any) -> dict[str, Any]:
    """Register the directive with Sphinx."""
    app.add_directive("command-line", CommandLine)
    return {"parallel_read_safe": True}


class CommandLine(SphinxDirective):
    """A section for each command: what it does, and its arguments."""

    def run(self) -> list[nodes.Node]:
        """Sections of all commands."""
        return [self._command(name) for name in commands()]

    def _command(self, name: str) -> nodes.section:
        module = module_of(name)
        parser = argparse.ArgumentParser(f"fide {name}", add_help=False)
        module.add_arguments(parser)
        section = nodes.section(ids=[f"fide-{name}"], names=[f"fide {name}"])
        section += nodes.title(text=f"fide {name}")
        section += _prose(module.__doc__ or "")
        lines = StringList(list(_arguments(parser)), source=f"fide {name} --help")
        self.state.nested_parse(lines, self.content_offset, section)
        return section


def _prose(text: str) -> list[nodes.Node]:
    """Paragraphs of a help text, and its indented examples as they stand."""
    made: list[nodes.Node] = []
    for block in text.strip().split("\n\n"):
        lines = block.split("\n")
        if lines[0].startswith("    "):
            code = "\n".join(line.removeprefix("    ") for line in lines)
            made.append(nodes.literal_block(code, code, language="text"))
        else:
            made.append(nodes.paragraph("", "", *_words(" ".join(map(str.strip, lines)))))
    return made


def _words(text: str) -> Iterator[nodes.Node]:
    """A text with its flags, placeholders and `names` in the type of code."""
    for part in re.split(r"(`[^`]+`|(?<!\w)--[a-z][a-z-]*|\{[^} ]+\})", text):
        is_code = part.startswith(("`", "--", "{"))
        yield nodes.literal(text=part.strip("`")) if is_code else nodes.Text(part)


def _arguments(parser: argparse.ArgumentParser) -> Iterator[str]:
    """reStructuredText: each group of arguments, each argument with its explanation."""
    yield f".. program:: {parser.prog}"
    yield ""
    for group in parser._action_groups:
        if not group._group_actions:
            continue
        if group.title not in ("positional arguments", "options"):
            yield from (f".. rubric:: {str(group.title).capitalize()}", "")
        for action in group._group_actions:
            yield f".. option:: {_signature(action)}"
            yield ""
            yield f"    {_escaped(action.help or '')}"
            yield ""


def _signature(action: argparse.Action) -> str:
    """Such as "--loss NAME", or "TARGET ..." for arguments without a flag."""
    value = action.metavar or (action.choices and "{" + ",".join(map(str, action.choices)) + "}")
    if not action.option_strings:
        several = " ..." if action.nargs in ("+", "*") else ""
        return f"{value or action.dest}{several}"
    takes = action.nargs != 0
    return ", ".join(
        f"{flag} {value or action.dest.upper()}" if takes else flag
        for flag in action.option_strings
    )


def _escaped(text: str) -> str:
    """A help text of argparse as reStructuredText."""
    return re.sub(r"([\\*`|_])", r"\\\1", text.replace("%%", "%")) or "…"
