"""Draws two diagrams of the guide: which tool for which problem, and the walk of one image.

    python docs/diagrams.py         # writes docs/images/which_tool.svg and walk.svg

Both have a white ground of their own, so that they can be read on dark pages, too.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH = 640
PLAIN, ASK, GOOD, OTHER = "#eef2f5", "#fff3d6", "#d9efe3", "#e3e8f5"
QUESTIONS = (  # question; what to take if the answer is yes; color
    ("Do renders give correct gradients,|and is your guess near?", "gradient descent", OTHER),
    ("Does a trial give a number,|and no image?", "CMA-ES, TPE (Optuna)", OTHER),
    ("Smooth, and a few hundred|renders at most?", "DFO-LS, least squares", OTHER),
    ("Many pictures of one scene?", "learn once, then fit(learned=)", GOOD),
    ("A photograph, or another|renderer's picture?",
     "fit(photo=True), with|a guess or a learned model", GOOD),
)  # fmt: skip


def box(x: float, y: float, width: float, height: float, text: str, color: str) -> str:
    """A rounded box with lines of text, separated by "|"."""
    lines = text.split("|")
    top = y + height / 2 - 9 * (len(lines) - 1) + 5
    rows = "".join(
        f'<text x="{x + width / 2}" y="{top + 18 * i}" text-anchor="middle">{escape(line)}</text>'
        for i, line in enumerate(lines)
    )
    place = f'x="{x}" y="{y}" width="{width}" height="{height}"'
    return f'<rect {place} rx="8" fill="{color}" stroke="#8a97a3"/>{rows}'


def arrow(*points: tuple[float, float], word: str = "", at: tuple[float, float] = (0, 0)) -> str:
    """Lines between points, with a head at the last, and a word."""
    line = " ".join(f"{x},{y}" for x, y in points)
    drawn = f'<polyline points="{line}" fill="none" stroke="#44505c" marker-end="url(#end)"/>'
    return drawn + (f'<text x="{at[0]}" y="{at[1]}" class="word">{word}</text>' if word else "")


def svg(title: str, height: int, parts: list[str]) -> str:
    """The whole picture."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" role="img">'
        f"<title>{title}</title><style>text{{font:14px sans-serif;fill:#17202a}}"
        ".word{font-size:13px;fill:#44505c}</style>"
        '<defs><marker id="end" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="9" '
        'markerHeight="9" orient="auto"><path d="M0 0L8 4L0 8z" fill="#44505c"/></marker></defs>'
        f'<rect width="{WIDTH}" height="{height}" rx="10" fill="#fff"/>'
    )
    return "\n".join([head, *parts, "</svg>"]) + "\n"


def which_tool() -> str:
    """Questions on the left; the tool for the first one that is answered by yes on the right."""
    parts = []
    for i, (question, tool, color) in enumerate(QUESTIONS):
        y = 16 + 78 * i
        parts.append(box(16, y, 270, 54, question, ASK))
        parts.append(box(366, y, 258, 54, tool, color))
        parts.append(arrow((286, y + 27), (366, y + 27), word="yes", at=(310, y + 20)))
        parts.append(arrow((151, y + 54), (151, y + 78), word="no", at=(160, y + 71)))
    y = 16 + 78 * len(QUESTIONS)
    parts.append(box(16, y, 608, 46, "fit(render, target, space)", GOOD))
    return svg("Which tool for which problem", y + 62, parts)


def walk() -> str:
    """From a candidate to its image, and what is learned of it for the next ones."""
    parts = [
        box(16, 16, 170, 54, "candidate|parameters in [0, 1]", PLAIN),
        box(235, 16, 170, 54, "your renderer", ASK),
        box(454, 16, 170, 54, "image", PLAIN),
        box(454, 116, 170, 54, "loss|one number", PLAIN),
        box(235, 116, 170, 54, "features|tokens (T, C)", PLAIN),
        box(235, 216, 170, 54, "proposer learns:|features → point", GOOD),
        box(454, 216, 170, 54, "CMA-ES ranks:|mean, covariance", GOOD),
        box(16, 216, 170, 54, "the target's features:|proposals", GOOD),
        arrow((186, 43), (235, 43), word="ask", at=(197, 36)),
        arrow((405, 43), (454, 43), word="tell", at=(418, 36)),
        arrow((539, 70), (539, 116)),
        arrow((470, 70), (380, 116), word="encoder", at=(352, 97)),
        arrow((539, 170), (539, 216)),
        arrow((320, 170), (320, 216)),
        arrow((235, 243), (186, 243)),
        arrow((101, 216), (101, 70)),
        arrow((539, 270), (539, 294), (60, 294), (60, 270)),
        f'<text x="{WIDTH / 2}" y="314" text-anchor="middle" class="word">'
        "samples around the mean; some of them become proposals</text>",
    ]
    return svg("The walk of one image", 328, parts)


if __name__ == "__main__":
    (IMAGES / "which_tool.svg").write_text(which_tool(), "utf-8")
    (IMAGES / "walk.svg").write_text(walk(), "utf-8")
