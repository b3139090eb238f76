"""A Mitsuba scene (XML) of the user's own, read before Mitsuba reads it.

A scene can name any file of the machine, and Mitsuba opens what it names; it even runs code that
lies as a plugin beside the scene. Its own parser opens included files and spectra before anyone can
see what they are called. So a scene is read here, by the rules of that parser: included files are
put in, parameters replaced, and files looked up where it would look. What is handed to Mitsuba is
the result, in which every name has been checked, and not the file.

The rules: parameters hold from where they are set, in the files that are included too, and the
first value of each counts. Files that a scene includes are looked up beside the one that includes
them first, all others beside the scene; before that come the folders of its <path> elements.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

__all__ = ["read", "text"]

_PLUGIN = re.compile(r"\w*")  # names of plugins; with a dot or a slash they would be paths
_REFERRING = ("include", "path", "default")  # elements that `_Reader.place` resolves


def read(file: Path) -> Element:
    """Return the scene in the file, an absolute path, as one element that refers to no other.

    Raises FileNotFoundError if a file that it names is missing; ValueError if it is malformed, or
    names a file outside its folder.
    """
    scene = _Reader(file).scene()
    for element in scene.iter():  # as the root of an included file, where Mitsuba takes none
        if element.tag in _REFERRING:
            raise ValueError(
                f"the scene {str(file)!r} includes a file whose root element is <{element.tag}>; "
                "make <scene> its root and put that element into it"
            )
    return scene


def text(scene: Element) -> str:
    """Write a scene that `read` returned for Mitsuba's `load_string`."""
    for element in scene.iter():
        for key, value in element.items():
            element.set(key, value.replace("$", r"\$"))
    return ElementTree.tostring(scene, encoding="unicode")


class _Reader:
    """Reads one scene.

    home: folder of the scene, out of which no name may lead.
    old: whether it is of a version in which parameters of plugins had other names.
    parameters: values that have been set so far.
    files: elements that name a file to be looked up when all folders are known.
    """

    def __init__(self, file: Path) -> None:
        self.file, self.home, self.old = file, file.parent, False
        self.parameters: dict[str, str] = {}
        self.files: list[Element] = []

    def scene(self) -> Element:
        root, folders = _parsed(self.file), [self.home]
        if root.tag != "scene":
            raise ValueError(
                f"{str(self.file)!r} is not a Mitsuba scene: its root element is <{root.tag}>"
            )
        self.old = _is_old(root)
        self.place(root, (self.file,), folders)
        for element in self.files:
            element.set("value", str(self.find(element.get("value", ""), folders)))
        return root

    def place(
        self, element: Element, chain: tuple[Path, ...], folders: list[Path]
    ) -> list[Element]:
        """Read an element; returns what stands in its place.

        chain: the files around it, the one that it is in last. folders: where files are looked up,
        the first one first; a <path> adds one.
        """
        for key, value in element.items():
            element.set(key, self.substituted(value))
        name, value = element.get("name", ""), element.get("value", "")
        if not _PLUGIN.fullmatch(element.get("type", "")):
            raise ValueError(
                f"the scene {str(self.file)!r} has an element of type {element.get('type')!r}, "
                "which is no name of a plugin of Mitsuba"
            )
        if element.tag == "default":
            self.parameters.setdefault(name, value)
            return []
        if element.tag == "path":
            folders.insert(0, self.find(value, [chain[-1].parent, *folders]))
            return []
        if element.tag == "include":
            return self.included(element, chain, [chain[-1].parent, *folders])
        if element.tag == "string":
            self.check_string(element, name, value)
        elif "filename" in element.attrib:  # a spectrum
            element.set("filename", str(self.find(element.get("filename", ""), folders)))
        element[:] = [e for child in element for e in self.place(child, chain, folders)]
        return [element]

    def included(
        self, include: Element, chain: tuple[Path, ...], folders: list[Path]
    ) -> list[Element]:
        """Return what an <include> brings: the contents of a scene, or one object."""
        file = self.find(include.get("filename", ""), folders)
        if file in chain:
            raise ValueError(f"the scene {str(self.file)!r} includes {str(file)!r} in itself")
        root = _parsed(file)
        if _is_old(root) != self.old:
            raise ValueError(
                f"the scene {str(self.file)!r} includes {str(file)!r}, in which parameters have "
                "other names (versions before 2.0 and later ones): bring both to one version"
            )
        self.place(root, (*chain, file), folders)
        if root.tag == "scene":
            return list(root)
        root.attrib.pop("version", None)
        root.attrib.pop("name", None)
        if "name" in include.attrib:
            root.set("name", include.attrib["name"])
        return [root]

    def check_string(self, element: Element, name: str, value: str) -> None:
        if name == "filename":
            self.files.append(element)
        elif Path(value).is_absolute() or ".." in Path(value).parts:
            self.refuse(
                value
            )  # a material of metals, say, of which Mitsuba makes the name of a file

    def find(self, name: str, folders: list[Path]) -> Path:
        """Return the absolute path of a file or folder that the scene names."""
        candidates = [folder / name for folder in folders]
        path = next(filter(os.path.exists, candidates), candidates[-1]).resolve()
        if not path.is_relative_to(self.home):
            self.refuse(name)
        if not path.exists():
            raise FileNotFoundError(
                f"the scene {str(self.file)!r} needs {str(path)!r}, which is missing"
            )
        return path

    def refuse(self, name: str) -> None:
        raise ValueError(
            f"the scene {str(self.file)!r} names {name!r}, which is outside its folder; put the "
            "scene and all its files into one folder"
        )

    def substituted(self, value: str) -> str:
        """Put values in place of $parameters, longest names first; a backslash keeps the $."""
        names = "|".join(map(re.escape, sorted(self.parameters, key=len, reverse=True)))
        if names:
            value = re.sub(rf"(?<!\\)\$({names})", lambda m: self.parameters[m[1]], value)
        unknown = re.search(r"(?<!\\)\$(\w*)", value)
        if unknown is not None:
            raise ValueError(
                f"the scene {str(self.file)!r} uses the parameter ${unknown[1]} before anything "
                f'sets it: add <default name="{unknown[1]}" value="..."/>'
            )
        return value.replace(r"\$", "$")


def _parsed(file: Path) -> Element:
    try:
        return ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{str(file)!r} is not well-formed XML: {error}") from error


def _is_old(root: Element) -> bool:
    return root.get("version", "").partition(".")[0] in ("0", "1")
