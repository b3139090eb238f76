"""Options of FIDE, and the presets.

`paper` is the published method, literally; `lab/reports/speed.md` measures what the others bring.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from typing import Any, TypeAlias

from fide_plugins.errors import OptionError, UnknownNameError
from fide_plugins.validation import options as rules

Rule: TypeAlias = rules.Rule

PAPER_SCHEDULE = (0.3, 0.2, 0.1)
"""Times of the sampler, supplement S1.  The last step goes to time 0, where z = x_hat."""


def _option(default: Any, rule: Rule) -> Any:
    return field(default=default, metadata={"rule": rule})


@dataclass(frozen=True, slots=True)
class Options:
    """Everything about an optimizer that does not change while it runs.

    encoder: name in `fide_plugins.encoders`.
    popsize: k, candidates a generation; None: 4 + 3 ln d.
    proposer: "linear" (parameters regressed on features), "both" (linear, and between the
        generations steps of a forward model, see `proposers.forward`; none with a learned model,
        or with more than 100 parameters or 4 k), "diffusion" (the published denoiser) or "none"
        (CMA-ES).
    restarts: where the next search begins: "moves" (they keep most of the best candidate, see
        `search.moves`), "anew" (at a random place); "none" for one search, to the end.  Without
        images, and with nothing proposed, "moves" is "anew".
    groups: exchangeable blocks of parameters, such as [[0, 1, 2], [3, 4, 5]]; None: they are found.
    patience, improvement: when a search is over that images guide, see `search.one_search`;
        patience None: 5 generations, or d / k if that is more.
    guard_images: let images guide the search, by proposals, moves and `patience`, only as far
        as they agree with the losses, see `proposers.image_gate`; otherwise it is CMA-ES.
    guard_search: cut injected steps and limit the standard deviation, see `search.cma_es`.
    coarse_to_fine: begin searches with blurred images, see `comparison.scale_space`; None: where
        the first candidates say that it helps, or with photo; True: from the first candidate on.
    memory_mb: MiB of tokens that are kept for `FIDE.retarget` and for `Solution.std`, see
        `population.Memory`; 0 for none: then no std is known.
    photometric: light that is set aside before images are compared, for each render: "exposure"
        (gain, offset and curve of each channel), "shading" (a smooth field of gains, too), "auto"
        (as far as the images say that the light differs), or None; see `fide_plugins.comparison`.
    robust: scale in (0, 1], of the range of values, beyond which differences count less and less;
        "auto": from the target; None: they count as they are.
    background: "free": pixels that a render does not cover (RGBA, or an image with its coverage)
        are explained by the target's colors; None: they are white.
    photo: for targets that the renderer did not draw: photometric="auto", robust="auto", and
        background="free" where renders have a coverage, unless these are given; renders get the
        blur of a camera.
    proposal_fraction: of a generation that is proposed at first.
    fraction_rate: speed of its adaptation, see `proposers.image_gate`; 0 keeps it as it is.
    channel_subsets: sets of leading channels of the tokens, such as (3, 16); empty: the encoder's
        own.  Moves compare images in the first of them.
    buffer_generations: generations that the linear proposer remembers; None: 4, but 8 of few
        parameters (d <= k); 3 in preset "fast"; of many (d > 4 k) at least 3 d / 2 candidates;
        600 candidates at most.
    screening: predict a parameter from the tokens that show it, where that is better, see
        `proposers.screening`; None: where the search begins at hypotheses of a learned model.
        Without effect of at most k parameters, or of very many or many channels.
    epochs, learning_rate, batch_size, schedule: of the published denoiser, see
        `proposers.diffusion`; refused where the proposer is no network.
    """

    encoder: str = _option("dense", rules.text("a name in fide_plugins.encoders"))
    popsize: int | None = _option(None, rules.whole(4, 2**20, "4 to 4,096 are tested"))
    proposer: str = _option("both", rules.one_of("both", "linear", "diffusion", "none"))
    restarts: str = _option("moves", rules.one_of("moves", "anew", "none"))
    patience: int | None = _option(None, rules.whole(1))
    improvement: float = _option(0.1, rules.fraction)
    groups: tuple[tuple[int, ...], ...] | None = _option(None, rules.groups)
    guard_images: bool = _option(True, rules.switch)
    guard_search: bool = _option(True, rules.switch)
    coarse_to_fine: bool | None = _option(None, rules.switch)
    memory_mb: float = _option(8.0, rules.not_negative)
    photometric: str | None = _option(None, rules.one_of("exposure", "shading", "auto"))
    robust: float | str | None = _option(None, rules.fraction_or("auto"))
    background: str | None = _option(None, rules.one_of("free"))
    photo: bool = _option(False, rules.switch)
    proposal_fraction: float = _option(0.3, rules.fraction)
    fraction_rate: float = _option(0.1, rules.fraction)
    channel_subsets: tuple[int, ...] = _option((), rules.whole_numbers)
    buffer_generations: int | None = _option(None, rules.whole(1))
    screening: bool | None = _option(None, rules.switch)
    epochs: int = _option(20, rules.whole(1, 10_000, "4 to 20 are published"))
    learning_rate: float = _option(1e-3, rules.positive)
    batch_size: int = _option(50, rules.whole(1))
    schedule: tuple[float, ...] = _option(PAPER_SCHEDULE, rules.schedule)


PRESETS: Mapping[str, Options] = {
    "fast": Options(
        proposer="linear", coarse_to_fine=False, channel_subsets=(3,), buffer_generations=3
    ),
    "balanced": Options(),
    "accurate": Options(patience=25),
    "paper": Options(
        encoder="patch",
        popsize=500,
        proposer="diffusion",
        restarts="none",
        guard_images=False,
        guard_search=False,
        coarse_to_fine=False,
        proposal_fraction=0.5,
        fraction_rate=0.0,
    ),
}

_NETWORK = ("epochs", "learning_rate", "batch_size", "schedule")
_FIRST = ("loss", "encoder", "preset", "popsize", "x0", "sigma0", "mask", "seed", "device")
_ARGUMENTS = (*_FIRST, "dim", "target", "weights", "value_range", "learned", "constraints")


def make_options(preset: str, changes: Mapping[str, Any]) -> Options:
    """The preset's options with `changes`, by name.

    None is a value where the option may be None, but for `popsize`; elsewhere it changes nothing.
    Raises OptionError or UnknownNameError (both ValueErrors) naming the option, its value and rule.
    """
    if not isinstance(preset, str) or preset not in PRESETS:
        raise UnknownNameError.of("preset", preset, PRESETS)
    known = {each.name: each for each in fields(Options)}
    changed: dict[str, Any] = {}
    for name, value in changes.items():
        if name not in known:
            raise OptionError(_unknown(name))
        if value is not None:
            changed[name] = known[name].metadata["rule"](name, value)
        elif known[name].default is None and name != "popsize":
            changed[name] = None
    made = replace(PRESETS[preset], **changed)
    for name in () if made.proposer == "diffusion" else _NETWORK:
        if getattr(made, name) != getattr(PRESETS[preset], name):
            raise OptionError(
                f"{name}={getattr(made, name)!r} is of the network, and the proposer "
                f"{made.proposer!r} has none: leave it out, or take preset='paper' or "
                "proposer='diffusion'"
            )
    return made


def without_images(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Options by name for a search that sees no image: CMA-ES, without those of a network."""
    kept = {name: value for name, value in changes.items() if name not in _NETWORK}
    return kept | {"proposer": "none", "encoder": "dense"}


def check_known(options: Mapping[str, Any], of: str, own: Sequence[str]) -> None:
    """Raise OptionError for a name that is no option of an optimizer.

    of: who takes these options, and hands them on; own: its own, which are known, too.
    """
    known = {*_ARGUMENTS, *own, *(each.name for each in fields(Options))}
    for name in options:
        if name not in known:
            raise OptionError(_unknown(name, of, own))


def _unknown(name: str, of: str = "FIDE", own: Sequence[str] = ()) -> str:
    """Error for a name that is no option; arguments as of `check_known`."""
    if name in _ARGUMENTS:
        return f"{name} is an argument of FIDE itself, not one of the options that are taken here"
    others = [each.name for each in fields(Options) if each.name not in (*own, *_FIRST)]
    close = get_close_matches(name, [*own, *_ARGUMENTS, *others], n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    known = ", ".join(dict.fromkeys([*own, *_FIRST, *others]))
    return f"{of} has no option {name!r}{hint}; known are {known}"
