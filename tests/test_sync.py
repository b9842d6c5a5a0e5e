"""The offset between a camera and an IMU or odometer, found from the motion that both saw."""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.image_motion import UNKNOWN, image_motion, small
from pipelines.time_offset import signal_offset
from readers.streams import (
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    ImageSample,
    ImuSample,
    OdometrySample,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
    StreamKind,
    array,
)
from workbench.cli import main
from workbench.sync import draw, sync

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
FOCAL = 150.0
Motion = Callable[[float], tuple[float, float, float]]


def texture(side: int = 900) -> NDArray[np.uint8]:
    noise = np.random.default_rng(5).normal(size=(side, side))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 60 * smooth / smooth.std(), 0, 255).astype(np.uint8)


GROUND = texture()


def view(turn: float, x: float, y: float, size: tuple[int, int] = (200, 160)) -> NDArray[np.uint8]:
    """The ground with the picture turned by `turn` clockwise and moved by (x, y) px; the centre is the origin."""
    centre, half = np.array([450.0, 450.0]), 0.5 * np.array(size)
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    matrix = np.column_stack([turned, half + np.array([x, y]) - turned @ centre])
    return np.asarray(cv2.warpAffine(GROUND, matrix, size), dtype=np.uint8)


class Mission(Recording):
    """A camera, an IMU and an odometer on one motion, with clocks that differ.

    `pose` gives the turn of the picture (rad) and its place (px) at a time in s; the camera's stamps are `late_s` too
    great. The gyro turns about -z with the picture if `axis` is 2; the odometer's speed is the place's in m, 500 px/m.
    """

    path, format = Path("made"), "made"

    def __init__(self, pose: Motion, late_s: float, *, rate_hz: float = 20.0, seconds: float = 12.0) -> None:
        self._pose, self._late, self._rate, self._seconds = pose, late_s, rate_hz, seconds

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        kinds = {"/camera": StreamKind.IMAGE, "/imu": StreamKind.IMU, "/odom": StreamKind.ODOMETRY}
        return tuple(StreamInfo(name=name, kind=kind, type="made") for name, kind in kinds.items())

    def _rates(self, t: float, step: float = 1e-4) -> tuple[float, float]:
        before, after = np.array(self._pose(t - step)), np.array(self._pose(t + step))
        rate = (after - before) / (2 * step)
        return float(rate[0]), float(np.hypot(rate[1], rate[2]))

    def _sample(self, stream: str, t: float) -> Sample:
        now = START + round(t * SECOND)
        turn, speed = self._rates(t)
        if stream == "/imu":
            return ImuSample(
                stream=stream,
                t_ns=now,
                received_ns=now,
                angular_velocity_radps=array(0.0, 0.0, -turn + 0.02),
                linear_acceleration_mps2=UNKNOWN_VEC3,
                quat_xyzw=UNKNOWN_QUAT,
            )
        if stream == "/odom":
            return OdometrySample(
                stream=stream,
                t_ns=now,
                received_ns=now,
                linear_velocity_mps=array(speed / 500, 0.0, 0.0),
                angular_velocity_radps=UNKNOWN_VEC3,
                position_m=UNKNOWN_VEC3,
                quat_xyzw=UNKNOWN_QUAT,
            )
        pixels = view(*self._pose(t))
        stamp = now + round(self._late * SECOND)
        return ImageSample(
            stream=stream,
            t_ns=stamp,
            received_ns=stamp,
            encoding="mono8",
            payload=pixels.tobytes(),
            width_px=pixels.shape[1],
            height_px=pixels.shape[0],
        )

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        (stream,) = streams or ("/camera",)
        rate = {"/imu": 200.0, "/odom": 50.0}.get(stream, self._rate)
        for k in range(int(self._seconds * rate)):
            yield self._sample(stream, k / rate)


def weaving(t: float) -> tuple[float, float, float]:
    """Turns of changing rate on the spot."""
    return 0.3 * np.sin(1.3 * t) + 0.1 * np.sin(3.7 * t + 1.0), 0.0, 0.0


def stop_and_go(t: float) -> tuple[float, float, float]:
    """Straight forth and back with pauses of changing length, at up to 60 px/s."""
    return 0.0, 25 * np.sin(1.1 * t) + 12 * np.sin(2.9 * t), 10 * np.sin(1.1 * t)


@pytest.mark.parametrize("late_s", [-0.15, 0.0, 0.0312, 0.4])
def test_a_cameras_lateness_is_found_from_turns_to_two_milliseconds(late_s: float) -> None:
    pairs = {pair.sensor: pair for pair in sync(Mission(weaving, late_s), sensors=("/imu",))}
    found = pairs["/imu"]
    assert found.signals == "turn of the image, turn about z"
    assert found.offset.offset_ns / 1e9 == pytest.approx(-late_s, abs=0.002)
    assert abs(found.offset.offset_ns / 1e9 + late_s) < 5 * max(found.offset.sigma_s, 1e-4)
    assert found.offset.scale == pytest.approx(-1.0, abs=0.02)  # the picture turns against the vehicle
    assert found.option == f"--offset /camera={found.offset.offset_ns / 1e6:.3f}"


def test_a_downward_cameras_way_is_held_against_the_odometers_speed() -> None:
    (found,) = sync(Mission(stop_and_go, 0.08), sensors=("/odom",))
    assert found.signals == "way of the image, speed"
    assert found.offset.offset_ns / 1e9 == pytest.approx(-0.08, abs=0.003)
    assert 1 / found.offset.scale == pytest.approx(500, rel=0.03)


def test_motions_that_have_nothing_in_common_tell_nothing(tmp_path: Path) -> None:
    class Apart(Mission):
        def _rates(self, t: float, step: float = 1e-4) -> tuple[float, float]:
            return float(np.sin(50.0 * t * t)), 0.0

    (found,) = sync(Apart(weaving, 0.0), sensors=("/imu",))
    assert not found.offset.determined
    assert found.option == ""
    with pytest.raises(StreamError, match="nothing to draw"):
        draw([found], tmp_path / "a.png")


def test_a_motion_that_repeats_itself_or_is_short_tells_nothing() -> None:
    t_ns = np.arange(0, 8 * SECOND, SECOND // 50)
    angle = np.sin(2 * np.pi * t_ns / 1e9 / 0.7)
    periodic = signal_offset(t_ns, angle, t_ns, angle)
    assert not periodic.determined
    assert "repeats itself" in periodic.reason
    short = signal_offset(t_ns[:60], angle[:60], t_ns, angle, max_offset_s=0.2)
    assert "too little of them: 4 s or more" in short.reason


def test_the_correlations_are_drawn(tmp_path: Path) -> None:
    draw(sync(Mission(weaving, 0.03, seconds=6.0)), tmp_path / "a.png")
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None
    assert picture.std() > 10


@pytest.mark.parametrize(("turn", "x", "y"), [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (-0.11, 4.0, -7.5), (0.0, 12.3, 0.4)])
def test_the_motion_of_an_image_is_what_it_was_moved_by(turn: float, x: float, y: float) -> None:
    found = image_motion(view(0.0, 0.0, 0.0), view(turn, x, y))
    assert found.turn_rad == pytest.approx(turn, abs=1e-3)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    centre = np.array([-0.5, -0.5])  # the image's centre from the point about which it was turned
    np.testing.assert_allclose(found.shift_px, rotation @ centre - centre + (x, y), atol=0.1)


@pytest.mark.parametrize(("turn", "x", "y"), [(0.0, 0.0, 18.0), (0.06, 5.0, -12.0), (-0.1, -9.0, 3.0)])
def test_the_motion_of_a_plane_that_is_seen_obliquely_is_that_at_the_images_centre(
    turn: float, x: float, y: float
) -> None:
    """The ground by a camera that is 35 degrees off the vertical: no similarity fits, and the answer is exact."""
    size, ground = (200, 160), np.array([[1, 0, 450], [0, 1, 450], [0, 0, 1.0]])
    lens = np.array([[150, 0, 99.5], [0, 150, 79.5], [0, 0, 1.0]])
    tilt = cv2.Rodrigues(np.array([0.6, 0.0, 0.0]))[0]
    scale = np.diag([1, 1, 150.0])  # the ground lies 150 of its pixels away

    def seen_after(angle: float, dx: float, dy: float) -> NDArray[np.float64]:
        moved = np.array([[np.cos(angle), -np.sin(angle), dx], [np.sin(angle), np.cos(angle), dy], [0, 0, 1]])
        return np.asarray(lens @ tilt @ scale @ moved @ np.linalg.inv(ground))

    def picture(mapping: NDArray[np.float64]) -> NDArray[np.uint8]:
        return np.asarray(cv2.warpPerspective(GROUND, mapping, size), np.uint8)

    first, second = seen_after(0.0, 0.0, 0.0), seen_after(turn, x, y)
    found = image_motion(picture(first), picture(second))
    mapping = second @ np.linalg.inv(first)

    def at(u: float, v: float) -> NDArray[np.float64]:
        place = mapping @ (u, v, 1.0)
        return np.asarray(place[:2] / place[2])

    across, down = at(100.0, 79.5) - at(99.0, 79.5), at(99.5, 80.0) - at(99.5, 79.0)
    np.testing.assert_allclose(found.shift_px, at(99.5, 79.5) - (99.5, 79.5), atol=0.1)
    assert found.turn_rad == pytest.approx(np.arctan2(across[1] - down[0], across[0] + down[1]), abs=2e-3)


def test_images_without_texture_or_of_other_sizes_tell_no_motion() -> None:
    flat = np.full((160, 200), 90, np.uint8)
    assert image_motion(flat, flat) == UNKNOWN
    assert image_motion(view(0, 0, 0), view(0, 0, 0)[:100]) == UNKNOWN
    assert image_motion(view(0, 0, 0), np.random.default_rng(1).integers(0, 255, (160, 200), np.uint8)) == UNKNOWN
    assert small(np.zeros((640, 1280), np.uint16)).shape == (160, 320)


def test_signals_with_gaps_and_noise_are_aligned_within_their_uncertainty() -> None:
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0, 40, 900))
    angle = np.cumsum(rng.normal(size=4001)) * 0.01
    smooth = np.convolve(angle, np.ones(41) / 41, "same")
    grid = np.arange(4001) * 0.01
    offsets = []
    for late in (-0.037, 0.012, 0.25):
        first = np.interp(t, grid, smooth) + rng.normal(0, 0.002, len(t))
        found = signal_offset(
            np.round((t + late) * 1e9).astype(np.int64), first, np.round(grid * 1e9).astype(np.int64), smooth
        )
        offsets.append((found.offset_ns / 1e9 + late) / found.sigma_s)
    assert np.abs(offsets).max() < 4.0
    with pytest.raises(ValueError, match="positive"):
        signal_offset(np.arange(5), np.arange(5.0), np.arange(5), np.arange(5.0), max_offset_s=0.0)


def test_a_simulated_missions_clock_offset_and_late_images_are_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drive over gravel with turns: the camera's clock is 25 ms ahead and its images are stamped 40 ms late."""
    file = tmp_path / "late.toml"
    file.write_text(
        'about = "late"\nduration_s = 5\n[trajectory]\ncurve = "serpentine"\nspeed_kmh = 2.0\n'
        "[camera]\nwidth_px = 256\nheight_px = 256\ntiming = { rate_hz = 30, clock_offset_s = 0.025 }\n"
        "[imu]\ntiming = { rate_hz = 200 }\n"
        '[[faults]]\nkind = "late-images"\nstart_s = 0\nstop_s = 5\nlatency_s = 0.04\n'
    )
    status = main(["sync", str(file), "--json"])
    (told,) = json.loads(capsys.readouterr().out)["pairs"]
    assert status == 0
    assert told["offset_ms"] == pytest.approx(-65.0, abs=max(5.0, 4 * told["sigma_ms"]))
    assert told["sigma_ms"] < 10


TURNS = "legs = [{turn_rad=0.7,turn_s=1.2},{drive_m=0.5},{turn_rad=-1.1,turn_s=1.7},{turn_rad=0.5,turn_s=0.9}]"
POSTERS = "[[8,-8,1],[9,-4,1],[9,0,1],[9,4,1],[8,8,1],[7,-6,2.5],[8,-2,2.5],[8,2,2.5],[7,6,2.5]]"
GROUND_AHEAD = "[ground]\nmetres_per_px = 0.004"
FORWARD = "focal_px = 120\nwidth_px = 160\nheight_px = 120\ntiming = { rate_hz = 20, clock_offset_s = 0.035 }"
TILTED = "focal_px = 110\nwidth_px = 160\nheight_px = 160\ntiming = { rate_hz = 25, clock_offset_s = 0.035 }"
VIEWS = {
    "straight ahead": f'curve = "line"\n{TURNS}\n{GROUND_AHEAD}\n[front]\n{FORWARD}',
    "down, tilted": f'curve = "serpentine"\nspeed_kmh = 4.0\n[camera]\npitch_rad = -0.5\n{TILTED}',
}


@pytest.mark.parametrize("name", VIEWS)
def test_the_clock_of_a_camera_that_does_not_look_straight_down_is_found(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its clock is 35 ms ahead of the IMU's."""
    file = tmp_path / "view.toml"
    sensors = f"[imu]\ntiming = {{ rate_hz = 200 }}\n[surroundings]\nposter_m = 1.5\nlandmarks_m = {POSTERS}\n"
    file.write_text(f'about = "{name}"\nduration_s = 5\n[trajectory]\n{VIEWS[name]}\n{sensors}')
    status = main(["sync", str(file), "--json"])
    (told,) = json.loads(capsys.readouterr().out)["pairs"]
    assert status == 0
    assert told["offset_ms"] == pytest.approx(-35.0, abs=min(4 * told["sigma_ms"], 5.0))
    assert told["sigma_ms"] < 4.0
    assert told["signals"].endswith("turn about z")
