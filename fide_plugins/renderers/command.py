"""A renderer that is a program, run once for each image; its command line has placeholders.

The template is split into arguments before values are filled in, and there is no shell.
"""

from __future__ import annotations

import json
import shlex
import shutil
import string
import time
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from inspect import Parameter
from pathlib import Path
from typing import Any

import numpy as np

from fide_plugins.errors import ImageError, OptionError, RenderError
from fide_plugins.renderers.child import folder_of_a_render, run, tail_of
from fide_plugins.renderers.keywords import DEFAULTS
from fide_plugins.renderers.naming import described, flat
from fide_plugins.runtime.registry import of_bytes
from fide_plugins.space import Choice, Space
from fide_plugins.types import Float32
from fide_plugins.validation.image_files import read_pixels
from fide_plugins.validation.images import as_target
from fide_plugins.validation.values import Pixels

TIMEOUT = 60.0
"""Seconds that a render may take, where none are given."""
FINE = ("width", "height", "samples", "seed")
"""Placeholders that say how fine an image is to be, unless the space has such a parameter."""


class CommandRenderer:
    """Function of a dictionary of parameters that runs a program and reads the image it writes.

    templates: command line of the program, see `Template`; or one for each view, then the images
        are a list.
    space: the parameters.
    timeout: seconds that a render may take, all views together, until its program is stopped; None
        waits for ever.
    raw: whether numbers of the image file are taken as they are stored, which a `value_range`
        needs; otherwise those of 8 and 16 bits are scaled to [0, 1].

    The program runs in the current folder.  The image and the file of parameters are in a temporary
    folder of their own, which is removed afterwards.

    Raises OptionError (a ValueError) for what can be known before the first render.  Calls raise
    RenderError, with the command and the last lines of its output: if it fails, does not end in
    time, or writes no image that can be read.
    """

    def __init__(
        self,
        templates: str | Sequence[str],
        space: Space,
        timeout: float | None = TIMEOUT,
        raw: bool = False,
    ) -> None:
        if timeout is not None and not timeout > 0:
            raise OptionError(f"timeout must be a number of seconds > 0, not {timeout!r}")
        self._given = templates
        texts = [templates] if isinstance(templates, str) else list(templates)
        self.templates = [Template(text, space) for text in texts]
        self.space, self.timeout, self.raw = space, timeout, raw
        used = {name for template in self.templates for name in template.used}
        unused = [name for name, axes in space.axes.items() if axes and name not in used]
        if unused and "params" not in used:
            raise OptionError(
                f"the parameter {unused[0]!r} of the space is nowhere in the command; write "
                f"{{{unused[0]}}} where the program expects it, or take it out of the space"
            )
        for template in self.templates:
            values = dict.fromkeys(FINE, 1) | space.decode(np.full(space.dim, 0.5))
            template.command(values, "out", "params")

    def __call__(
        self,
        params: Mapping[str, Any],
        *,
        size: tuple[int, int] = DEFAULTS["size"],
        samples: int = DEFAULTS["samples"],
        seed: int = 0,
    ) -> Pixels | list[Pixels]:
        """Image (H, W, 3), float32, of the parameters, or one for each view.

        Its values lie in [0, 1]; those of a file of floats are as they are, as a function's are.
        size: (H, W); with samples and seed for the placeholders of these names, if there are any.
        """
        until = None if self.timeout is None else time.monotonic() + self.timeout
        fine = {"width": size[1], "height": size[0], "samples": samples, "seed": seed}
        values = {**fine, **params}
        pictures = [self._render(template, params, values, until) for template in self.templates]
        return pictures[0] if isinstance(self._given, str) else pictures

    @property
    def keywords(self) -> dict[str, Any]:
        """Those of `renderers.keywords` that the command has placeholders for."""
        used = {name for template in self.templates for name in template.fine}
        asked = {"size": used & {"width", "height"}, "samples": "samples" in used}
        asked["seed"] = "seed" in used
        return {name: Parameter.empty for name, there in asked.items() if there}

    @property
    def name(self) -> str:
        """Name of the program."""
        return Path(self.templates[0].words[0]).name

    @property
    def fingerprint(self) -> str:
        """Of the command lines."""
        return of_bytes("command", "\0".join(each.text for each in self.templates).encode())

    def __reduce__(self) -> tuple[Any, ...]:
        return CommandRenderer, (self._given, self.space, self.timeout, self.raw)

    def __repr__(self) -> str:
        return f"CommandRenderer({', '.join(repr(each.text) for each in self.templates)})"

    def _render(
        self,
        template: Template,
        params: Mapping[str, Any],
        values: Mapping[str, Any],
        until: float | None,
    ) -> Pixels:
        with folder_of_a_render() as folder:
            written, log, parameters = folder / "image", folder / "output.txt", folder / "params"
            written.mkdir()
            if "params" in template.used:
                parameters = folder / "params.json"
                parameters.write_text(json.dumps(params), "utf-8")
            out = written / f"out{template.suffix}"
            command = template.command(values, str(out), str(parameters))
            try:
                self._run(command, log, until)
                return _read(out, self.raw)
            except (_Failed, ImageError) as failed:
                shown = template.command(values, out.name, "params.json")
                tail = tail_of(log) if log.exists() else ""
                output = f"its last output:\n{tail}" if tail else "it printed nothing"
                reason = str(failed).replace(f"{written}/", "")
                raise RenderError(
                    f"{command[0]} {reason}\nwith the parameters {described(params)}\n"
                    f"to see it, run: {shlex.join(shown)}\n{output}"
                ) from None

    def _run(self, command: list[str], log: Path, until: float | None) -> None:
        left = None if until is None else max(0.0, until - time.monotonic())
        try:
            code = run(command, log, left).code
        except OSError as error:
            raise _Failed(f"cannot be started: {error}") from error
        if code is None:
            together = "" if isinstance(self._given, str) else " for all views together"
            raise _Failed(
                f"did not end within {self.timeout:g} s{together}; give it more time (timeout; in "
                "the shell --timeout), or make it faster"
            )
        if code:
            raise _Failed(
                f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
            )


class _Failed(Exception):
    """What a program did that gave no image."""


def _read(out: Path, raw: bool) -> Pixels:
    """The image that was written: the file `out`, or the only one in its folder."""
    files = [out] if out.exists() else [path for path in out.parent.glob("*") if path.is_file()]
    if len(files) != 1:
        names = ", ".join(sorted(path.name for path in files))
        what = f"wrote several files, but not {out.name}: {names}" if files else "wrote no image"
        raise _Failed(f"{what}; is {{out}} where it expects the name?")
    try:
        return read_pixels(files[0], None, raw=True) if raw else _pixels(files[0])
    except ImageError as error:
        raise _Failed(f"wrote an image that cannot be read: {error}") from None


def _pixels(path: Path) -> Float32:
    """Image (H, W, 3).  Floats keep NaN and overshoot, which a mask may hide or `tell` clip."""
    pixels = read_pixels(path, None)
    if pixels.dtype == np.float32 and pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    if pixels.dtype == np.float32 and pixels.shape[2] == 3:
        return pixels
    return as_target(pixels, what=repr(str(path)))


_FILES = ("out", "params")  # placeholders that are no parameters
_SHELL = ("|", "||", "&", "&&", ";", ">", ">>", "<", "2>", "2>&1", "&>")


class Template:
    """Command line for the parameters of a space.

    Raises OptionError (a ValueError) for what can be known before its program runs: words, names,
    formats, and a program that is not on this machine.
    """

    def __init__(self, text: str, space: Space) -> None:
        self.text = text
        try:
            self.words = shlex.split(text)
            fields = [field for word in self.words for field in _fields(word)]
        except ValueError as error:
            raise OptionError(
                f"the command {text!r} cannot be read ({error}); write {{{{ and }}}} for braces, "
                "and quotes in pairs"
            ) from None
        self.used = {name for name, _, _ in fields}
        self.fine = {name for name in FINE if name in self.used and name not in space.names}
        """Placeholders for how fine the image is to be."""
        self.suffix = next((spec for name, spec, _ in fields if name == "out" and spec), ".png")
        """Ending of the image's name."""
        _check_words(self.words, text)
        _check_names(self.used, space, text)
        for name, spec, conversion in fields:  # each of whose renders would fail
            kind = space.parameters.get(name)
            for value in kind.values if isinstance(kind, Choice) else ():
                _formatted(name, value, spec, conversion, text)

    def command(self, params: Mapping[str, Any], out: str, params_file: str) -> list[str]:
        """Arguments, the program first; OptionError if a value does not fit its format."""
        values = {**dict(flat(params)), "out": out, "params": params_file}
        return [self._fill(word, values) for word in self.words]

    def _fill(self, word: str, values: Mapping[str, Any]) -> str:
        filled = []
        for literal, name, spec, conversion in string.Formatter().parse(word):
            filled.append(literal)
            if name is not None:
                form = "" if name in _FILES else spec or ""
                filled.append(_formatted(name, values[name], form, conversion, self.text))
        return "".join(filled)


def _fields(word: str) -> list[tuple[str, str, str | None]]:
    """Name, format and conversion of each placeholder; ValueError for what is none."""
    parsed = list(string.Formatter().parse(word))
    if any(spec and "{" in spec for _, _, spec, _ in parsed):
        raise ValueError(f"a placeholder inside another one in {word!r}")
    return [(name, spec or "", c) for _, name, spec, c in parsed if name is not None]


def _check_words(words: list[str], text: str) -> None:
    if not words:
        raise OptionError("the command is empty; write the program and its arguments")
    for word in words:
        if word in _SHELL:
            raise OptionError(
                f"{word!r} would be an argument, because no shell reads the command; put such a "
                "line into a script, and make the script the command"
            )
    if "{" not in words[0] and shutil.which(words[0]) is None:
        raise OptionError(
            f"no program {words[0]!r} that may be executed; install it, write its whole path (no "
            f"shell reads ~), or the program that runs it first, such as sh: {text!r}"
        )


def _check_names(used: set[str], space: Space, text: str) -> None:
    taken = [name for name in _FILES if name in space.names]
    if taken:
        raise OptionError(
            f"no parameter of a command may be called {taken[0]!r}, which is the name of a file in "
            f"it; call it {taken[0]}_"
        )
    known = [*_FILES, *space.names, *(name for name in FINE if name not in space.names)]
    for name in sorted(used):
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f"; did you mean {{{close[0]}}}?" if close else ""
            raise OptionError(
                f"{{{name}}} in the command is no parameter of the space; known are "
                f"{', '.join(known)}{hint}"
            )
    if "out" not in used:
        raise OptionError(
            f"the command has no {{out}}, so the image would not be found: {text!r}; put {{out}} "
            "where the program expects the name of the image"
        )


def _formatted(name: str, value: Any, spec: str, conversion: str | None, text: str) -> str:
    if conversion is not None:
        value = repr(value) if conversion == "r" else str(value)
    try:
        return format(value, spec)
    except (ValueError, TypeError) as error:
        raise OptionError(
            f"{{{name}:{spec}}} in the command does not fit the value {value!r} ({error}): "
            f"{text!r}; take a format that all of its values fit, or write {{{name}}}"
        ) from None
