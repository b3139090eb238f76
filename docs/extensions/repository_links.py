"""Links from a page to what is in the repository and not on the site.

A link to a file is a download; Sphinx does that by itself.  A link to a folder, or to a Markdown
file beside code, becomes its text and the path.  ARCHITECTURE.md and the like are pages of the
site.  A path that does not exist stays what it is: a warning, which fails the build.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms.post_transforms import SphinxPostTransform

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    "ARCHITECTURE.md": "reference/architecture",
    "CHANGELOG.md": "reference/changelog",
    "CONTRIBUTING.md": "reference/contributing",
    "README.md": "index",
}
"""Pages that are made of a file outside this folder."""


def setup(app: Any) -> dict[str, Any]:
    """Register the transform with Sphinx."""
    app.add_post_transform(RepositoryLinks)
    return {"parallel_read_safe": True}


class RepositoryLinks(SphinxPostTransform):
    """Replaces such links before MyST looks for their pages."""

    default_priority = 8  # MyST's is 9

    def run(self, **kwargs: Any) -> None:
        """Replace them in one document."""
        for node in list(self.document.findall(addnodes.pending_xref)):
            if node["reftype"] == "myst" and node["reftarget"] not in self.env.all_docs:
                self._replace(node)

    def _replace(self, node: addnodes.pending_xref) -> None:
        path = self._path(node)
        if path is None:
            return
        name = path.relative_to(ROOT).as_posix()
        if name in PAGES:
            node["refdomain"], node["reftarget"] = "doc", PAGES[name]
            node["reftargetid"] = None
            return
        shown = nodes.inline("", "", *(child.deepcopy() for child in node.children))
        if name not in shown.astext():
            shown += [nodes.Text(" ("), nodes.literal(name, name), nodes.Text(")")]
        node.replace_self(shown)

    def _path(self, node: addnodes.pending_xref) -> Path | None:
        """What the link means: relative to its page, or to the root for a page that is included."""
        target = node["reftarget"].partition("#")[0].removeprefix(ROOT.as_posix()).lstrip("/")
        folder = Path(self.env.doc2path(node["refdoc"])).parent
        for start in (folder, ROOT):
            for suffix in ("", ".md"):
                path = (start / (target + suffix)).resolve()
                if target and path.exists() and path.is_relative_to(ROOT) and path != ROOT:
                    return path
        return None
