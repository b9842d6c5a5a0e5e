"""What --calibrate tells of a run of ranges: made-up biases, mountings and delays are found again."""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import fake_ranges
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.ranging.range_settings import MotionModel, RangeSettings
from pipelines.ranging.step import RangeStep
from workbench.range_calibration import SensorCalibration

SETTINGS = RangeSettings(focal_px=fake_ranges.FOCAL, centre_px=fake_ranges.CENTRE)
DRIVE = list(fake_ranges.steps(100, slots=6, count=6))


def told(steps: Iterable[RangeStep], settings: RangeSettings = SETTINGS, *, imu: bool = True) -> dict[str, Any]:
    sensors = SensorCalibration(settings, imu)
    for step in steps:
        sensors.take(step)
    return sensors.told()


def moved(steps: Iterable[RangeStep], by_px: tuple[float, float]) -> list[RangeStep]:
    """The same steps with every image point shifted."""
    return [dataclasses.replace(step, measured_px=step.measured_px + np.array(by_px)) for step in steps]


def test_the_focus_of_a_straight_drive_is_where_it_was_made() -> None:
    found = told(DRIVE)
    off = (np.array(found["focus"]["focus_px"]) - fake_ranges.CENTRE) / found["focus"]["sigma_px"]
    assert np.abs(off).max() < 3
    assert max(found["focus"]["sigma_px"]) < 3
    assert "they agree" in found["sentence"]


def test_a_focus_elsewhere_gives_the_setting_that_puts_it_right() -> None:
    shift = (40.0, -25.0)
    aligned = told(moved(DRIVE, shift), SETTINGS.model_copy(update={"motion": MotionModel.ALIGNED}))
    at = np.array(aligned["focus"]["focus_px"])
    assert (np.abs(at - fake_ranges.CENTRE - shift) < 4 * np.array(aligned["focus"]["sigma_px"])).all()
    assert f"--set centre_px=[{at[0]:.2f},{at[1]:.2f}]" in aligned["sentence"]
    planar = told(moved(DRIVE, shift))
    text = planar["sentence"].split("--set camera_quat_xyzw=[")[1].split("]")[0]
    body_r_camera = Rotation.from_quat([float(v) for v in text.split(",")]).as_matrix()
    ray = np.append((at - fake_ranges.CENTRE) / fake_ranges.FOCAL, 1.0)
    ahead = body_r_camera @ ray / np.linalg.norm(ray)
    np.testing.assert_allclose(ahead, [1, 0, 0], atol=1e-5)


def test_the_bias_is_that_of_the_frames_at_rest() -> None:
    rest = [dataclasses.replace(step, still=1, omega_radps=0.004, gyro_bias_radps=0.001, dt_s=0.1) for step in DRIVE]
    found = told([*rest[:20], *DRIVE[20:]])
    assert found["gyro_bias"]["radps"] == pytest.approx(0.005)
    assert found["gyro_bias"]["sigma_radps"] == pytest.approx(SETTINGS.sigma_omega / math.sqrt(2.0))
    # the camera's y axis points down, the robot's z axis up
    assert "--set gyro_bias=given --set gyro_bias_radps=[0.000000,0.000000,-0.005000]" in found["sentence"]
    assert "gyro_bias" not in told(DRIVE)
    assert "never stood still" in told(DRIVE)["sentence"]
    assert "the odometry's" in told(rest, imu=False)["sentence"]


def turning(late_s: float) -> list[RangeStep]:
    """A camera that turns among far landmarks; the gyro's stamps are late by `late_s`."""
    times = np.arange(100) * fake_ranges.DT_S

    def heading(t: Any) -> Any:
        return 0.06 * np.sin(1.3 * t) + 0.02 * np.sin(3.1 * t)

    bearing = np.linspace(-0.3, 0.3, 6)
    made = []
    for k, step in enumerate(DRIVE):
        u = fake_ranges.CENTRE[0] + fake_ranges.FOCAL * np.tan(bearing - heading(times[k]))
        omega = (heading(times[k] - late_s) - heading(times[k] - late_s - fake_ranges.DT_S)) / fake_ranges.DT_S
        points = np.column_stack([u, np.full(6, 200.0)])
        made.append(
            dataclasses.replace(
                step, measured_px=points, landmark_id=np.arange(6.0), omega_radps=omega, outcome=np.zeros(6)
            )
        )
    return made


@pytest.mark.parametrize("late_s", [0.12, -0.07, 0.0])
def test_the_time_offset_is_the_one_that_was_made(late_s: float) -> None:
    found = told(turning(late_s))
    assert found["time_offset"]["seconds"] == pytest.approx(late_s, abs=0.01)
    assert found["time_offset"]["correlation"] > 0.99


def test_what_cannot_be_told_says_why() -> None:
    found = told(DRIVE[:2])
    assert found["key"] == ""
    assert len(found["sentences"]) == 3
    assert all("cannot be told" in sentence for sentence in found["sentences"])
    straight = told(DRIVE)
    assert "time_offset" not in straight
    assert "drive more turns" in straight["sentence"]
