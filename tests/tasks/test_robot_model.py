"""Robot: models of the user's own, with a room; and what is no Panda."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fide_tasks import panda
from fide_tasks.robot import Robot

pytestmark = pytest.mark.usefixtures("opengl")

Image = NDArray[np.float32]


@pytest.fixture(scope="module")
def task() -> Robot:
    return Robot(64)


def random_x(n: int, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).random((n, 7))


def arm(
    folder: Path, joints: int = 7, extra: str = "", name: str = "joint{}", mesh: str = ""
) -> Path:
    """Write a chain of thin links with a Panda's axes; a gripper comes before it."""
    bodies, end = "", ""
    for i, (a, d, alpha) in enumerate(panda.DH[:joints]):
        place = f"{a} {-d * np.sin(alpha)} {d * np.cos(alpha)}"
        bodies += (
            f'<body pos="{place}" euler="{alpha} 0 0"><joint name="{name.format(i + 1)}" '
            f'axis="0 0 1"/><geom type="sphere" size="0.07" rgba="0.9 0.1 0.1 1"/>'
        )
        end += "</body>"
    hand = mesh or '<geom type="box" size="0.02 0.08 0.02" pos="0 0 0.15" rgba="0 0 1 1"/>'
    path = folder / "arm.xml"
    path.write_text(
        f'<mujoco><compiler angle="radian"/>{extra}<worldbody>'
        f'<body name="loose"><joint name="finger_joint1" type="slide"/>'
        f'<geom type="sphere" size="0.01"/></body>{bodies}{hand}{end}</worldbody></mujoco>'
    )
    return path


def blue(image: Image) -> NDArray[np.bool_]:
    return np.asarray((image[..., 2] > 0.3) & (image[..., :2].max(axis=-1) < 0.12))


def test_a_model_file_has_the_same_kinematics(tmp_path: Path, task: Robot) -> None:
    own = Robot(64, model=arm(tmp_path))
    for x in random_x(10, 6):
        np.testing.assert_allclose(own.link_poses(x), task.link_poses(x), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(own.x_star, task.x_star)
    image = own.target
    assert blue(image).any()
    assert not blue(task.target).any()
    assert own.reference(np.full(7, 0.5)).shape == (64, 64, 3)
    assert Robot(16, model=str(arm(tmp_path))).target.shape == (16, 16, 3)


def test_a_model_keeps_its_own_room(tmp_path: Path) -> None:
    extra = (
        '<asset><texture type="skybox" builtin="flat" rgb1="0 1 0" rgb2="0 1 0" width="8" '
        'height="8"/></asset><worldbody><geom type="plane" size="1 1 1" rgba="1 0 0 1"/>'
        '<light pos="0 0 3" dir="0 0 -1"/></worldbody>'
    )
    file = arm(tmp_path, extra=extra)
    task = Robot(64, model=file)
    names = [task._model.geom(i).name for i in range(task._model.ngeom)]
    assert "fide floor" not in names
    assert task._model.nlight == 1
    image = task.target
    np.testing.assert_allclose(image[0, 0], [0, 1, 0], atol=0.01)


@pytest.mark.parametrize(("joints", "named"), [(6, r"has joint1, .*joint6"), (0, "has none")])
def test_models_that_are_no_panda_are_named(tmp_path: Path, joints: int, named: str) -> None:
    with pytest.raises(ValueError, match=rf"not a Panda: .*seven hinge.* {named}"):
        Robot(16, model=arm(tmp_path, joints=joints))


def test_files_that_are_missing_or_malformed_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no model file .*nothing.xml"):
        Robot(16, model=tmp_path / "nothing.xml")
    extra = '<compiler meshdir="assets"/><asset><mesh name="hand" file="hand.stl"/></asset>'
    file = arm(tmp_path, extra=extra, mesh='<geom type="mesh" mesh="hand"/>')
    with pytest.raises(FileNotFoundError, match=r"arm.xml.*hand.stl.*meshes"):
        Robot(16, model=file)
    bad = tmp_path / "bad.xml"
    for text in ("<mujoco><worldbody>", "<scene/>", "", "<mujoco><world/></mujoco>"):
        bad.write_text(text)
        with pytest.raises(ValueError, match=r"cannot load the model .*bad.xml"):
            Robot(16, model=bad)
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets/hand.stl").write_bytes(b"no triangles")
    with pytest.raises(ValueError, match=r"cannot load the model"):
        Robot(16, model=file)
    with pytest.raises(TypeError, match="model must be a path"):
        Robot(16, model=7)  # type: ignore[arg-type]
