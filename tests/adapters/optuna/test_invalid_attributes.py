"""A storage that anybody can write to: invalid attributes are ignored with one warning."""

from __future__ import annotations

from typing import Any

import numpy as np
import optuna
import pytest

from .conftest import Bench, counts_of, with_attributes

ASKED: dict[str, Any] = {"v": 2, "optimizer": "x", "generation": 0, "slot": 0}


@pytest.mark.parametrize(
    ("attributes", "as_if"),
    [
        ({"constraints": [-1.0, "high"]}, []),
        ({"constraints": "high"}, []),
        ({"constraints:a": {"b": 1}}, []),
        ({"constraints:a": None, "constraints:b": np.float32(2.0)}, [2.0]),
        ({"constraints": "high", "constraints:b": 10**400}, [1e300]),
    ],
)
def test_a_constraint_that_is_no_number_is_ignored_with_a_warning(
    bench: Bench, attributes: dict[str, Any], as_if: list[float]
) -> None:
    samplers = [bench.sampler(), bench.sampler()]
    for sampler, stored in zip(samplers, (attributes, {"constraints": as_if}), strict=True):
        study = optuna.create_study(sampler=sampler)
        bench.run(study, 5)
        study.add_trial(with_attributes(bench, stored, value=0.0))
        if stored is attributes:
            with pytest.warns(RuntimeWarning, match="not a number") as caught:
                bench.run(study, 10)
            assert len(caught) == 1
            asked = bench.points(study)
        else:
            bench.run(study, 10)
            np.testing.assert_array_equal(bench.points(study), asked)


INVALID: list[Any] = [
    "text",
    {**ASKED, "v": 1},
    {**ASKED, "generation": -1},
    {**ASKED, "generation": 0.5},
    {**ASKED, "generation": True},
    {**ASKED, "optimizer": 3},
    {**ASKED, "skipped": "all"},
    {**ASKED, "late": list(range(1000))},
    {**ASKED, "skipped": [99]},
    {**ASKED, "slot": 10**30},
    {**ASKED, "guided": 1},
    {**ASKED, "problem": 3},
    {**ASKED, "more": 3},
    [1, 2, 3],
    None,
]


@pytest.mark.parametrize("record", INVALID)
@pytest.mark.parametrize("key", ["fide:ask", "fide:image"])
def test_invalid_attributes_are_ignored_with_one_warning(
    bench: Bench, key: str, record: Any
) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    for _ in range(3):
        study.add_trial(with_attributes(bench, {key: record}))
    if record is None:
        bench.run(study, 5)
    else:
        with pytest.warns(RuntimeWarning, match=key) as caught:
            bench.run(study, 5)
        assert len(caught) == 1
    assert counts_of(study) == {"injected": 3, "member": 5, "image": 5}


@pytest.mark.parametrize("code", ["no code", "AAAA", 3, None, {"d": "AAAA"}])
def test_a_corrupt_code_counts_without_its_image(bench: Bench, code: Any) -> None:
    """As another worker would have left it, all but the code of the features."""
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 5)
    good = study.trials[-1].system_attrs["fide:image"]
    study.add_trial(with_attributes(bench, {"fide:image": {**good, "code": code}}))
    with pytest.warns(RuntimeWarning, match="fide:image") as caught:
        bench.run(study, 5)
    assert len(caught) == 1
    assert counts_of(study) == {"injected": 1, "member": 10, "image": 10}


@pytest.mark.parametrize("seed", ["0", -1, 1.0, True, [0], 2**2000])
def test_a_seed_that_is_none_is_replaced_with_a_warning(bench: Bench, seed: Any) -> None:
    study = optuna.create_study(sampler=bench.sampler(seed=None))
    study._storage.set_study_system_attr(study._study_id, "fide:seed", seed)
    with pytest.warns(RuntimeWarning, match="fide:seed") as caught:
        bench.run(study, 3)
    assert len(caught) == 1
    stored = study._storage.get_study_system_attrs(study._study_id)["fide:seed"]
    assert type(stored) is int and stored >= 0
