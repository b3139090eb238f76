"""Figures as SVG and PNG files, and as SVG elements of a page.

In a page, element ids get a prefix that is unique to the figure, colors become variables that a
dark theme can change, text uses the font of the page, and elements with a gid get it as class.
"""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from fide_lab.report.plots import INK, MUTED, PALETTE, PART_COLORS, RULE

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.figure import Figure

__all__ = ["VARIABLES", "as_file", "in_page", "markup", "png"]

VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    RULE: "rule",
    **{color: f"series-{i}" for i, color in enumerate(PALETTE)},
    **{color: f"part-{part}" for part, color in PART_COLORS.items()},
}
"""Color in a figure, and the name of its CSS variable in the page."""


def as_file(figure: Figure) -> bytes:
    """SVG file with text as text and without a date, so that equal figures give equal files."""
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "fide"}):
        figure.savefig(buffer, format="svg", facecolor="white", metadata={"Date": None})
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """PNG on white, 200 dots per inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200, facecolor="white", metadata={"Software": None})
    return buffer.getvalue()


def _shortened(path: str) -> str:
    """Path data rounded down to hundredths of a point, after a space."""
    return " " + re.sub(r"(\.\d\d)\d+", r"\1", " ".join(path.split()))


def in_page(file: bytes, name: str, description: str) -> str:
    """SVG element for a page, made from a figure's SVG file.

    name: unique in the page, of letters, digits and "-"; description: text alternative.
    """
    text = file.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r" d=\"[^\"<>]*\"", lambda path: _shortened(path[0]), text)
    text = re.sub(r"\sid=\"(s\d+ \w+|legend)\"", r' class="\1"', text)
    text = re.sub(r"(\sid=\"|url\(#|href=\"#)", rf"\g<1>{name}-", text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, f"var(--{variable})")
    text = re.sub(r"fill: #ffffff", "fill: none", text)
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", text)
    head = f'<svg role="img" aria-label={quoteattr(description)} '
    size = re.compile(r"<svg width=\"[^\"]*\" height=\"[^\"]*\" |<svg ")
    return size.sub(lambda _: head, text, count=1)  # a function: names may hold backslashes


def markup(file: bytes, name: str, description: str) -> Markup:
    """As `in_page`, for a template, which does not escape it."""
    from markupsafe import Markup

    return Markup(in_page(file, name, description))
