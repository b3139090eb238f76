"""Targets that the renderer did not draw: light, clutter, background."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fide_plugins import FIDE, fit
from fide_plugins.cli.fit_command import add_arguments
from fide_plugins.comparison.auto import camera_blur, has_other_colors
from fide_plugins.comparison.kept import Kept
from fide_plugins.comparison.light import Light, common_light, fit_light
from fide_plugins.comparison.mismatch import explanation
from fide_plugins.comparison.scale_space import blurred
from fide_plugins.errors import ImageError, LossError, OptionError
from fide_plugins.evaluation import Evaluator
from fide_plugins.options import Options
from fide_plugins.status import Facts, status_of

Image = npt.NDArray[np.float32]
SIZE = 32
TRUE = np.array([0.3, 0.6])
_V, _U = np.mgrid[0:SIZE, 0:SIZE] / SIZE


def coverage(x: npt.ArrayLike) -> Image:
    """A square of a third of the side, its corner at x."""
    u, v = np.asarray(x) * 0.66
    inside = (abs(_U - u - 0.17) < 0.17) & (abs(_V - v - 0.17) < 0.17)
    return np.asarray(inside, np.float32)


def render(x: npt.ArrayLike) -> Image:
    """The square, striped, before a gradient."""
    square = 0.5 + 0.4 * np.sin(40 * (_U + _V))[..., None] * [1, 0.5, 0.2]
    back = np.stack([0.2 + 0.5 * _U, 0.3 + 0.3 * _V, 0.6 - 0.3 * _U], axis=-1)
    return np.where(coverage(x)[..., None] > 0, square, back).astype(np.float32)


def exposed(image: Image) -> Image:
    return np.asarray(np.clip(0.85 * image, 0, 1) ** 1.35 * 0.9 + 0.04, np.float32)


def shaded(image: Image) -> Image:
    field = 0.7 + 0.5 * _U * _V + 0.2 * _V
    return np.asarray(image * field[..., None], np.float32)


def evaluator(
    target: Image, loss: str | None = None, mask: object = None, **options: Any
) -> Evaluator:
    return Evaluator(target, loss, "dense", mask=mask, options=Options(**options))


def losses(made: Evaluator, images: Any, note: bool = False) -> npt.NDArray[np.float64]:
    n = len(images)
    batch = made.as_batch(n, images, None, lambda clip: None)
    return made.evaluate(n, batch, note=note).losses


def fitted(target: Image, renders: int, **options: Any) -> FIDE:
    optimizer = FIDE(2, target, seed=0, **options)
    while optimizer.evaluations < renders:
        X = optimizer.ask()
        optimizer.tell(X, [render(x) for x in X])
    return optimizer


def test_without_an_option_nothing_is_compared_in_another_way() -> None:
    assert evaluator(render(TRUE)).comparison is None
    assert FIDE(2, render(TRUE)).state.kept is None


@pytest.mark.parametrize(
    ("option", "change", "left"), [("exposure", exposed, 0.03), ("shading", shaded, 0.05)]
)
def test_light_of_the_target_is_set_aside(option: str, change: Any, left: float) -> None:
    """At the answer hardly anything of the loss is left; elsewhere most of it is."""
    target = change(render(TRUE))
    plain, adjusted = evaluator(target), evaluator(target, photometric=option)
    here, far = render(TRUE), render([0.9, 0.1])
    assert losses(adjusted, [here])[0] < left * losses(plain, [here])[0]
    assert losses(adjusted, [far])[0] > 5 * losses(adjusted, [here])[0]


def test_an_equal_render_stays_as_it_is() -> None:
    image = render(TRUE)
    for options in ({"photometric": "shading"}, {"robust": 0.1}, {"photo": True}):
        made = evaluator(image, **options)
        assert losses(made, [image])[0] < 1e-10
        assert made.comparison is not None
        np.testing.assert_allclose(made.comparison.compare(image[None]).images[0], image, atol=1e-5)


def test_of_a_constant_render_the_prior_decides() -> None:
    """Its gain, offset and curve cannot be told apart."""
    flat = np.full((SIZE, SIZE, 3), 0.4, np.float32)
    for kind in ("exposure", "shading"):
        light = evaluator(flat + np.float32(0.1), photometric=kind).light_of(flat)
        assert (abs(light.gain - 1) < 0.2).all()
        assert (abs(light.offset) < 0.2).all()
        assert (abs(light.gamma - 1) < 0.3).all()
    black = evaluator(flat, photometric="exposure").light_of(0 * flat)
    np.testing.assert_allclose(black.gain, 1)  # nothing says anything of it


@pytest.mark.parametrize("kind", ["exposure", "shading"])
def test_no_light_inverts_a_picture(kind: str) -> None:
    """Else a board that is one square off equals its photograph."""
    image = np.tile(np.linspace(0, 1, 28, dtype=np.float32)[:, None, None], (1, 28, 3))
    light = fit_light(image, 1 - image, None, kind)
    assert (np.diff(light.applied(image), axis=0) > 0).all()


def test_robust_differences_are_bounded() -> None:
    """What is there beside the scene costs little, wherever the scene is."""
    target = render(TRUE).copy()
    target[2:12, 2:12] = [1, 0, 1]
    scale = 0.1
    plain, robust = evaluator(target), evaluator(target, robust=scale)
    here = render(TRUE)
    assert losses(robust, [here])[0] < 100 / SIZE**2 * scale**2 < losses(plain, [here])[0]
    assert losses(robust, [render([0.9, 0.1])])[0] > 2 * losses(robust, [here])[0]


def test_coverage_comes_as_alpha_or_beside_the_image() -> None:
    target = render(TRUE)
    image, a = render(TRUE), coverage(TRUE)
    rgba = np.concatenate([image, a[..., None]], axis=-1)
    made = evaluator(target, background="free")
    values = [losses(made, given)[0] for given in ([(image, a)], [rgba], rgba[None])]
    np.testing.assert_allclose(values, values[0], rtol=1e-5)
    whole = losses(made, [image])[0]  # all of it is covered
    assert whole < values[0]


def test_with_a_free_background_neither_all_nor_nothing_wins() -> None:
    """The target has the square before something that the renderer does not know."""
    rng = np.random.default_rng(0)
    target = np.where(coverage(TRUE)[..., None] > 0, render(TRUE), rng.random((SIZE, SIZE, 3)))
    made = evaluator(target.astype(np.float32), background="free", robust="auto")
    truth, wrong, nothing, everything = losses(
        made,
        [
            (render(TRUE), coverage(TRUE)),
            (render([0.9, 0.1]), coverage([0.9, 0.1])),
            (render(TRUE), 0 * coverage(TRUE)),
            (render(TRUE), 0 * coverage(TRUE) + 1),
        ],
    )
    assert truth < min(wrong, nothing, everything)


def test_where_it_is_not_used_a_coverage_is_ignored() -> None:
    image, a = render(TRUE), coverage(TRUE)
    made = evaluator(render([0.5, 0.5]))
    assert losses(made, [(image, a)])[0] == losses(made, [image])[0]


@pytest.mark.parametrize(
    ("a", "rule"),
    [
        (np.ones((SIZE, SIZE + 1), np.float32), "size of its image"),
        (np.full((SIZE, SIZE), np.nan, np.float32), "finite"),
    ],
)
def test_a_coverage_that_does_not_fit_is_refused_before_anything_changes(a: Any, rule: str) -> None:
    optimizer = FIDE(2, render(TRUE), background="free", seed=0)
    X = optimizer.ask(1)
    with pytest.raises(ImageError, match=rule):
        optimizer.tell(X, [(render(X[0]), a)])
    assert optimizer.evaluations == 0
    optimizer.tell(X, [(render(X[0]), coverage(X[0]))])


def test_a_target_that_is_all_background_is_compared() -> None:
    flat = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    made = evaluator(flat, photo=True)
    values = losses(made, [(render(TRUE), 0 * coverage(TRUE)), (render(TRUE), coverage(TRUE))])
    assert np.isfinite(values).all()
    assert values[0] <= values[1]


@pytest.mark.parametrize(
    "options",
    [{"photometric": "gain"}, {"robust": 0}, {"robust": "much"}, {"background": "white"},
     {"photo": 1}],
)  # fmt: skip
def test_options_are_checked(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        FIDE(2, render(TRUE), **options)


def test_a_mask_leaves_its_pixels_out_of_light_and_loss() -> None:
    target, mask = exposed(render(TRUE)).copy(), np.ones((SIZE, SIZE), np.float32)
    clean = evaluator(target, photometric="exposure")
    target[:8], mask[:8] = 1, 0
    masked = evaluator(target, photometric="exposure", mask=mask)
    assert losses(masked, [render(TRUE)])[0] < 3 * losses(clean, [render(TRUE)])[0] + 1e-5


def test_views_have_a_light_each() -> None:
    one, other = render(TRUE), render([0.8, 0.2])
    made = evaluator([exposed(one), other], photometric="exposure")  # type: ignore[arg-type]
    batch = made.as_batch(1, [[one], [other]], None, lambda clip: None)
    assert made.evaluate(1, batch).losses[0] < 1e-3
    assert batch is not None
    first, second = made.light_of(np.asarray(batch)[0])
    assert abs(first.gain.mean() - 1) > 0.05 > abs(second.gain.mean() - 1)


def test_auto_adjusts_the_light_where_it_differs_and_finds_the_answer() -> None:
    optimizer = fitted(exposed(render(TRUE)), 200, photometric="auto")
    best = optimizer.best
    assert best is not None
    assert abs(best.x - TRUE).max() < 0.03
    assert best.photometric is not None
    assert best.photometric.gamma.mean() > 1.02
    assert optimizer.state.comparisons == 1
    assert np.asarray(optimizer.residual).shape == (SIZE, SIZE)
    image = np.asarray(best.image)
    assert optimizer.residual.mean() < 0.1 * abs(image - optimizer.target).mean()
    np.testing.assert_allclose(optimizer.adjust(image[None])[0], optimizer.target, atol=0.1)


def test_auto_sets_no_light_aside_where_renders_have_the_colors_of_the_target() -> None:
    """A gray that is a parameter explains another exposure, and so do lines that are nowhere."""
    grays = [np.full((8, 8, 3), gray, np.float32) for gray in np.linspace(0.4, 0.7, 12)]
    assert not has_other_colors(grays[0] + np.float32(0.1), grays)
    assert has_other_colors(grays[0] * 0, grays)
    assert has_other_colors(grays[0], grays[:2])  # too few
    moved = [render(x) for x in np.random.default_rng(0).random((12, 2))]
    assert not has_other_colors(render(TRUE), moved)
    assert has_other_colors(exposed(render(TRUE)), moved)


def test_a_texture_has_no_place_and_nothing_is_set_aside() -> None:
    made = evaluator(render(TRUE), loss="texture", photo=True)
    assert made.comparison is not None and made.comparison.scale is None
    assert not made.adapts_light


def test_auto_leaves_a_clean_picture_as_it_is() -> None:
    optimizer = fitted(render(TRUE), 120, photometric="auto")
    assert optimizer.state.comparisons == 0
    assert optimizer.best is not None
    assert optimizer.best.photometric is None


def test_after_a_change_the_best_is_the_best_in_the_new_comparison() -> None:
    """No loss of before is left: neither in `best` nor in what the search remembers."""
    optimizer = FIDE(2, exposed(render(TRUE)), seed=0, photometric="auto")
    told = []
    while not optimizer.state.comparisons:
        X = optimizer.ask()
        optimizer.tell(X, [render(x) for x in X])
        told += list(X)
    values = losses(optimizer.evaluator, [render(x) for x in told])
    assert optimizer.best is not None
    assert optimizer.best.loss == pytest.approx(values.min())
    remembered = [sample.loss for sample in optimizer.state.memory.samples]
    assert set(np.round(remembered, 9)) <= set(np.round(values, 9))
    assert optimizer.evaluations == len(told)


def test_a_checkpoint_goes_on_in_the_same_light(tmp_path: Any) -> None:
    optimizer = fitted(exposed(render(TRUE)), 60, photo=True)
    optimizer.save(tmp_path / "run")
    again = FIDE.load(tmp_path / "run")
    assert again.evaluator.comparison is not None
    assert again.evaluator.comparison.light == "exposure"
    for _ in range(3):
        X, same = optimizer.ask(), again.ask()
        np.testing.assert_array_equal(X, same)
        images = [render(x) for x in X]
        np.testing.assert_array_equal(optimizer.tell(X, images), again.tell(same, images))


def test_losses_that_a_user_tells_are_not_replaced() -> None:
    optimizer = FIDE(2, exposed(render(TRUE)), seed=0, photometric="auto")
    for _ in range(4):
        X = optimizer.ask()
        optimizer.tell(X, [render(x) for x in X], np.square(X).sum(axis=1))
    assert optimizer.state.comparisons == 0


def test_fit_takes_images_with_coverage_and_says_what_is_left() -> None:
    target = exposed(render(TRUE))
    result = fit(
        lambda x: (render(x), coverage(x) * 0 + 1), target, 2,
        budget=120, workers=0, seed=0, photo=True,
    )  # fmt: skip
    assert result.best is not None
    assert abs(result.best.x - TRUE).max() < 0.05
    assert result.residual.shape == (SIZE, SIZE)
    assert result.best.photometric is not None
    best = result.optimizer.best
    assert best is not None and best.loss == result.best.loss <= result.losses[-1]


LIGHT = np.full((SIZE, SIZE, 3), 0.1, np.float32)
CLUTTER = np.zeros((SIZE, SIZE, 3), np.float32)
CLUTTER[4:12, 4:12] = 0.4


@pytest.mark.parametrize(
    ("target", "agreed", "cause"),
    [
        (render(TRUE) + LIGHT, False, "another light"),
        (blurred(render(TRUE), 1.5), False, "blur"),
        (render(TRUE) + CLUTTER, True, "small part"),
        (render(TRUE) + CLUTTER, False, None),  # so differs the image of a local optimum
        (render(TRUE) + 0.01, True, None),
        (render([0.9, 0.1]), False, None),
    ],
)
def test_what_is_left_is_named(target: Image, agreed: bool, cause: str | None) -> None:
    said = explanation(render(TRUE), target, None, agreed=agreed)
    assert said is None if cause is None else said is not None and cause in said


def test_of_a_render_that_covers_nothing_nothing_is_said() -> None:
    nothing = np.zeros((SIZE, SIZE), np.float32)
    assert explanation(render(TRUE), 0 * render(TRUE), nothing, agreed=True) is None


def test_status_of_a_mismatch_names_the_cause() -> None:
    facts = Facts(1000, 0.1, 10, 100, [3], mismatch="another light explains 90% of it")
    assert status_of(facts).code == "mismatch"
    assert "another light" in status_of(facts).sentence


def test_command_line_takes_the_options() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args(
        ["a.png", "--renderer", "a.py:f", "--photo", "--robust", "--photometric", "exposure"]
    )
    assert (args.photo, args.robust, args.photometric) == (True, "auto", "exposure")
    args = parser.parse_args(["a.png", "--renderer", "a.py:f", "--robust", "0.2"])
    assert (args.photo, args.robust, args.background) == (None, 0.2, None)


@pytest.mark.parametrize("blur", [0.0, 1.0])
def test_renders_are_as_soft_as_a_camera_makes_the_target(blur: float) -> None:
    target = blurred(render(TRUE), blur)
    optimizer = fitted(target, 60, photo=True)
    comparison = optimizer.evaluator.comparison
    assert comparison is not None and comparison.camera == pytest.approx(blur, abs=0.4)
    one, other = losses(optimizer.evaluator, [render(TRUE), blurred(render(TRUE), 1.5)])
    assert one < 1e-3 and one < other
    assert optimizer.residual.mean() < 0.05


def test_a_camera_is_known_whatever_light_is_asked_for() -> None:
    optimizer = fitted(blurred(render(TRUE), 1.0), 60, photo=True, photometric="exposure")
    comparison = optimizer.evaluator.comparison
    assert comparison is not None and comparison.light == "exposure"
    assert comparison.camera == pytest.approx(1.0, abs=0.4)


def test_a_target_without_edges_says_nothing_of_a_camera() -> None:
    renders = [render(x) for x in np.random.default_rng(0).random((6, 2))]
    shade = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    for target in (np.full_like(renders[0], 0.5), shade + np.zeros_like(renders[0])):
        assert camera_blur(target, renders) == 0
    assert camera_blur(blurred(renders[0], 1.0), renders[1:]) == pytest.approx(1.0, abs=0.4)
    lines = [one[:1] for one in renders]
    assert camera_blur(lines[0], lines) == 0


def test_hidden_colors_are_none_of_the_target() -> None:
    mask = np.ones((SIZE, SIZE), np.float32)
    mask[: SIZE // 2] = 0
    target = render(TRUE)
    target[mask == 0] = 0
    comparison = evaluator(target, mask=mask, photo=True).comparison
    assert comparison is not None
    moved = np.array([render(x) for x in np.random.default_rng(0).random((12, 2))])
    assert not comparison.has_other_colors(moved)


def test_one_light_of_all_renders_is_that_of_the_photograph() -> None:
    """By what does not move, wherever the object is in them."""

    def small(u: int, v: int) -> Image:
        image = render([2.0, 2.0])  # the ground alone
        image[v : v + 4, u : u + 4] = [0.9, 0.2, 0.1]
        return image

    here, target = small(20, 8), shaded(small(20, 8))
    renders = np.stack([small(*at) for at in np.random.default_rng(0).integers(0, 28, (12, 2))])
    light = common_light(renders, target, None, "shading")
    assert light is not None
    left = np.square(light.applied(here) - target).mean()
    assert left < 0.05 * np.square(here - target).mean()
    other = np.random.default_rng(1).random(renders.shape, np.float32)
    assert common_light(other, target, None, "shading") is None


def test_the_floor_is_what_no_render_removes() -> None:
    target = render(TRUE).copy()
    target[:8, :8] = [1, 0, 1]
    made = evaluator(target, photo=True)
    assert made.comparison is not None and made.comparison.floor == 0
    values = losses(made, [render(x) for x in ([0.9, 0.1], [0.2, 0.4], TRUE)], note=True)
    assert made.comparison.floor == pytest.approx(values[2])
    assert made.comparison.floor < values[:2].min()
    before = made.comparison.least
    made.adjusted([target])
    with pytest.raises(LossError):
        made.evaluate(1, target[None], ["bad"], note=True)
    assert made.comparison.least is before, "no candidate was told"


def test_views_of_two_sizes_go_on_from_a_file(tmp_path: Path) -> None:
    views = [render(TRUE), render(TRUE)[:20]]
    one = FIDE(2, views, seed=0, popsize=8, photometric="exposure")

    def tell(optimizer: FIDE) -> None:
        X = optimizer.ask()
        images = [render(x) for x in X]
        optimizer.tell(X, [images, [image[:20] for image in images]])

    tell(one)
    one.save(tmp_path / "photo.ckpt")
    other = FIDE.load(tmp_path / "photo.ckpt")
    tell(one)
    tell(other)
    np.testing.assert_array_equal(one.ask(), other.ask())


def test_what_is_left_counts_where_it_is_seen_and_covered() -> None:
    a, seen = coverage(TRUE), np.tri(SIZE, dtype=np.float32)
    for mask in (None, seen):
        comparison = evaluator(render(TRUE), mask=mask, photo=True).comparison
        assert comparison is not None
        ((*_, weights),) = comparison.leftovers(np.dstack([render(TRUE), a]))
        np.testing.assert_array_equal(weights, a if mask is None else a * seen)


@pytest.mark.parametrize(("gain", "curve"), [(0.7, 0.0), (0.0, 0.9), (0.4, 0.5), (1.4, -0.4)])
def test_gamma_is_the_slope_at_middle_gray_on_logarithmic_axes(gain: float, curve: float) -> None:
    light = Light(np.full((1, 1, 3), gain), np.zeros(3), np.full(3, curve))
    grays = np.repeat(np.array([0.48, 0.52], np.float32), 3).reshape(1, 2, 3)
    slope = np.diff(np.log(light.applied(grays)), axis=1) / np.diff(np.log(grays), axis=1)
    np.testing.assert_allclose(light.gamma, slope[0, 0], rtol=1e-3)


@pytest.mark.parametrize("on", [(False, False), (False, True), (True, False), (True, True)])
def test_what_is_left_comes_with_its_option_unless_it_is_on(on: tuple[bool, bool]) -> None:
    for change, option, is_on in ((LIGHT, "photometric=", on[0]), (CLUTTER, "robust=", on[1])):
        said = explanation(render(TRUE), render(TRUE) + change, None, agreed=True, adjusts=on)
        assert said is not None and (option in said) != is_on


@pytest.mark.parametrize("order", [(3, 4), (4, 3)])
def test_kept_renders_without_a_coverage_are_covered(order: tuple[int, int]) -> None:
    kept, given = Kept(2), np.random.default_rng(0).random((2, SIZE, SIZE, 4), np.float32)
    given[0, ..., 3] = 1
    for c in order:  # the opaque one is the better
        kept.note(
            np.zeros((1, 2)), given[c - 3, None, ..., :c], np.array([float(c)]), 0, given=False
        )
    assert kept.images is not None
    np.testing.assert_array_equal(kept.images, given)
