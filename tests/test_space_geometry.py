"""SO(3) and SE(3) against scipy's matrix exponential and logarithm."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pipelines.geometry import hat, quat_of_rotation, se3_exp, se3_inverse, se3_log, se3_product, so3_exp, so3_log

ANGLES = [0.0, 1e-9, 1e-5, 5e-3, 2e-2, 0.7, 2.0, 2.6, 3.0, np.pi - 1e-4, np.pi - 1e-9]


def twist(angle: float, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])


def test_hat_is_the_cross_product() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 3))
    assert np.allclose(hat(a) @ b, np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("seed", range(4))
def test_exponentials_and_logarithms(angle: float, seed: int) -> None:
    xi = twist(angle, seed)
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = hat(xi[3:]), xi[:3]
    assert np.allclose(se3_exp(xi), expm(generator), atol=1e-12)
    assert np.allclose(so3_exp(xi[3:]), Rotation.from_rotvec(xi[3:]).as_matrix(), atol=1e-14)
    assert np.allclose(so3_log(so3_exp(xi[3:])), xi[3:], atol=1e-9)
    assert np.allclose(se3_log(se3_exp(xi)), xi, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("seed", range(6))
def test_quaternions_of_rotations(angle: float, seed: int) -> None:
    rotation = Rotation.from_rotvec(twist(angle, seed)[3:])
    found = quat_of_rotation(rotation.as_matrix())
    assert found[np.argmax(np.abs(found))] > 0
    assert np.linalg.norm(found) == pytest.approx(1, abs=1e-15)
    assert (Rotation.from_quat(found) * rotation.inv()).magnitude() < 1e-14


def test_inverse_and_product() -> None:
    a, b = se3_exp(twist(1.0, 5)), se3_exp(twist(2.0, 6))
    assert np.allclose(se3_product(a, b), a @ b, atol=1e-15)
    assert np.allclose(se3_inverse(a) @ a, np.eye(4), atol=1e-15)
