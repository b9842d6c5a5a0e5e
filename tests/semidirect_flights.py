"""Short flights over a smooth plane: what the semi-direct odometry is tested on."""

import dataclasses
import functools
from collections.abc import Iterable

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from textured_plane import texture

from pipelines import lens
from pipelines.semidirect.odometry import SemidirectOdometry
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.semidirect.step import SemidirectStep
from pipelines.spatial import umeyama
from readers.streams import Camera, ImageSample

WIDTH, HEIGHT, FOCAL = 320, 240, 200.0
RATE_NS = 16_666_667
DOWN = np.diag([1.0, -1.0, -1.0])
CAMERA = Camera(
    width_px=WIDTH,
    height_px=HEIGHT,
    matrix=np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]]),
    distortion_model="none",
    distortion=np.zeros(0),
    rectification=np.eye(3),
    projection=np.zeros((3, 4)),
)


LENSES = {
    "none": ("none", ()),
    "radial-tangential": ("plumb_bob", (-0.28, 0.07, 0.0002, -0.0001, 0.0)),
    "equidistant": ("equidistant", (-0.01, 0.004, 0.0, 0.0)),
}


def settings(**changes):
    """Settings for the small pictures of these flights."""
    small = {"focal_px": FOCAL, "cell_px": 20, "max_features": 80, "min_tracked": 30, "start_motion_px": 25.0}
    return SemidirectSettings(**small | {"start_min_inliers": 30, "start_min_matches": 40, "height_m": 1.5} | changes)


@functools.cache
def way(frames=90, climb=0.0):
    """Centres [n, 3] and rotations camera to world [n, 3, 3] of a flight at 1.5 m that sways and turns.

    It may climb, m/s.
    """
    t = np.arange(frames) / 60.0
    centres = np.column_stack([1.6 * t, 0.15 * np.sin(2.5 * t), 1.5 + 0.05 * np.sin(1.7 * t) + climb * t])
    angles = np.column_stack([0.25 * np.sin(1.1 * t), 0.03 * np.sin(4 * t), 0.03 * np.sin(3.1 * t + 1)])
    angles -= angles[0] * (0, 1, 1)
    return centres, Rotation.from_euler("ZYX", angles).as_matrix() @ DOWN


GROUND_M = 0.004
WEST_M, NORTH_M = -2.0, 2.0


@functools.cache
def ground():
    """The plane from above at 4 mm a pixel, float32; the waves of the texture are ten pixels long and more."""
    x, y = np.meshgrid(WEST_M + GROUND_M * np.arange(1800), NORTH_M - GROUND_M * np.arange(1000))
    return texture(x, y).astype(np.float32)


@functools.cache
def sight_lines(through="none"):
    """Directions of the pixels in camera axes [rows * cols, 3]."""
    model, coefficients = LENSES[through]
    camera = dataclasses.replace(CAMERA, distortion_model=model, distortion=np.array(coefficients))
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return lens.rays(camera, np.column_stack([u.ravel(), v.ravel()]).astype(float))


@functools.cache
def pictures(frames=90, noise=1.0, through="none", climb=0.0):
    """What the camera sees on its way, uint8 [frames, rows, cols], with noise of so many grey levels."""
    rng = np.random.default_rng(5)
    found = []
    for centre, turn in zip(*way(frames, climb), strict=True):
        lines = sight_lines(through) @ turn.T
        east, north = (centre[:2] - lines[:, :2] * (centre[2] / lines[:, 2:])).T.reshape(2, HEIGHT, WIDTH)
        at = ((east - WEST_M) / GROUND_M).astype(np.float32), ((NORTH_M - north) / GROUND_M).astype(np.float32)
        clean = cv2.remap(ground(), *at, cv2.INTER_CUBIC)
        found.append(np.clip(np.rint(clean + rng.normal(0, noise, clean.shape)), 0, 255).astype(np.uint8))
    return np.array(found)


def sample(grey, frame, t_ns=None):
    """A picture as the replay gives it to an estimator."""
    stamp = frame * RATE_NS if t_ns is None else t_ns
    rows, cols = grey.shape
    return ImageSample(
        stream="/camera", t_ns=stamp, received_ns=stamp, frame=frame, encoding="mono8", payload=grey.data.cast("B"),
        width_px=cols, height_px=rows, step_bytes=cols, big_endian=False,
    )  # fmt: skip


def flown(estimator, samples, state=None):
    """The steps of an estimator and its state after them."""
    state = estimator.start() if state is None else state
    steps: list[SemidirectStep] = []
    for one in samples:
        state, step = estimator.step(state, one)
        if step is not None:
            steps.append(step)
    return steps, state


@functools.cache
def flight(frames=90, **changes):
    """The steps of one flight, once a session."""
    samples = (sample(grey, k) for k, grey in enumerate(pictures(frames)))
    return flown(SemidirectOdometry(settings(**changes)), samples)[0]


def places(steps: Iterable[SemidirectStep]):
    """Frame numbers [n] and camera centres [n, 3] of the accepted steps."""
    good = [s for s in steps if s.accepted]
    return np.array([s.frame for s in good]), np.array([s.position_m for s in good])


def path_error(steps, frames=90, climb=0.0):
    """RMS distance from the true way after alignment over its length, and the scale of the alignment."""
    numbers, found = places(steps)
    truth = way(frames, climb)[0][numbers]
    rotation, shift, scale = umeyama(found, truth, with_scale=True)
    error = truth - (scale * found @ rotation.T + shift)
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return np.sqrt((error**2).sum(1).mean()) / length, scale
