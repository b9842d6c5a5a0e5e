"""Our renderer beside cv2.warpPerspective: frames per second, and how far from the truth the frames' content is.

    python benchmarks/rendering.py [--frames 60]

Frames of 512 x 512 px of the same gravel, on one core, CPU time of the one thread that works, the least of all
frames (other programs disturb the rest). Ours is `view` + `expose` with noise; theirs is the warp of the picture
of the same ground, of one pixel per pixel, + `expose`.

The bias is the error of the least-squares shift on a quintic spline, window 212 x 212, no noise, over shifts of
0, 1/8, … 7/8 px along u: the amplitude of its sine (S-curve) and the largest.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from pipelines.lens import pinhole
from pipelines.simulation.motion import FORWARD, Mount, Waypoints
from pipelines.simulation.render import expose, noise_key_of, radiance, view, world_h_pixel
from pipelines.simulation.scene import Plane, Relief, Scene, chessboard, poster, upright
from pipelines.simulation.surfaces import Surface, gravel

Image = NDArray[np.float32]
Floats = NDArray[np.float64]

SIDE, HEIGHT_M, FOCAL_PX = 512, 0.2002, 256.0
W = HEIGHT_M / FOCAL_PX
FRACTIONS = np.arange(8) / 8
NADIR_CAMERA = pinhole(SIDE, SIDE, FOCAL_PX)
BELOW = Mount(np.array([0.0, 0.0, HEIGHT_M]))
DRIVE = Waypoints(np.array([0.0, 10.0]), np.array([[0.0, 0.0, 0.0], [5.0, 1.0, 2.0]]))


class Row(NamedTuple):
    """One line of the table; a bias is NaN where the views are no shifted copies of one another."""

    name: str
    seconds: float
    s_curve_px: float
    largest_px: float


# ----------------------------------------------------------------------------------- peers


def picture_of(surface: Surface) -> Image:
    """The picture of the ground at one pixel per pixel, its first sample at the world's origin."""
    columns, rows = (round(length / W) for length in surface.period_m)
    centre = np.array([[1, 0, (SIDE - 1) / 2], [0, 1, (SIDE - 1) / 2], [0, 0, 1]])
    to_ground = world_h_pixel(np.zeros(3), NADIR_CAMERA.matrix, HEIGHT_M) @ centre
    return radiance(surface, to_ground, (rows, columns))


def warped(picture: Image, flag: int, pose: Floats) -> Image:
    """The view from a pose by OpenCV."""
    to_picture = np.diag([1 / W, -1 / W, 1]) @ world_h_pixel(pose, NADIR_CAMERA.matrix, HEIGHT_M)
    return cv2.warpPerspective(
        picture, to_picture, (SIDE, SIDE), flags=flag | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_WRAP
    )


# ------------------------------------------------------------------------------- judgement


def bias(see: Callable[[Floats], Image]) -> tuple[float, float]:
    """S-curve and largest error in px of views that are shifted along u."""
    at = np.array([(256 + (SIDE - 1) / 2) * W, -(SIDE - 1) / 2 * W, 0.0])  # pixels on the picture's pixels
    before = see(at)
    errors = np.array([shift_error(before, see(at - [d * W, 0, 0]), d) for d in FRACTIONS])
    return float(2 * np.mean(errors * np.sin(2 * np.pi * FRACTIONS))), float(np.abs(errors).max())


def shift_error(before: Image, after: Image, shift_px: float) -> float:
    """Least-squares shift along u, quintic spline, window 212 x 212, minus the true one."""
    side, edge = 212, (SIDE - 212) // 2
    rows, columns = np.mgrid[edge : edge + side, edge : edge + side].astype(float)
    spline = scipy.ndimage.spline_filter(after.astype(float), order=5, mode="mirror")
    d = np.array([shift_px, 0.0])

    def sample(du: float, dv: float) -> Floats:
        places = [rows + d[1] + dv, columns + d[0] + du]
        return scipy.ndimage.map_coordinates(spline, places, order=5, prefilter=False, mode="mirror")

    for _ in range(3):
        slopes = [sample(1, 0) - sample(-1, 0), sample(0, 1) - sample(0, -1)]
        jacobian = np.stack(slopes, axis=-1).reshape(-1, 2) / 2
        left = before[edge : edge + side, edge : edge + side] - sample(0, 0)
        d += np.linalg.lstsq(jacobian, left.ravel(), rcond=None)[0]
    return float(d[0] - shift_px)


def least_seconds(see: Callable[[float], Image], frames: int) -> float:
    """CPU time of the quickest frame, rendered and exposed, after two to warm up."""
    spent = []
    for k in range(frames + 2):
        start = time.thread_time()
        expose(see(10 * k / (frames + 2)), noise_key=noise_key_of(0, k), noise_grey=2.0)
        spent.append(time.thread_time() - start)
    return min(spent[2:])


def forward_scene(ground: Surface) -> tuple[Scene, Mount]:
    """A room: ground, two walls, a chessboard at 5 m, three posters; a camera 0.7 m above the ground."""
    rng = np.random.default_rng(1)
    rough = gravel(256, rng, metres_per_px=0.004)
    planes = (
        Plane(rough, upright(np.array([14.0, 0, 0]), np.pi), (-6.0, 6.0, 0.0, 2.5)),
        Plane(rough, upright(np.array([7.0, -4, 0]), np.pi / 2), (-7.0, 7.0, 0.0, 2.5)),
        chessboard(7, 6, 0.1, upright(np.array([8.0, 1.2, 0.9]), np.pi)),
        *(poster(np.array([x, y, 1.0]), rng=rng) for x, y in ((9.0, -0.8), (10.0, 3.0), (11.0, -2.0))),
    )
    return Scene(ground, planes=planes), Mount(np.array([0.0, 0.0, 0.7]), FORWARD)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60, help="frames per method")
    frames = parser.parse_args().frames
    cv2.setNumThreads(1)
    ground = gravel(512, np.random.default_rng(0))
    scene, picture = Scene(ground), picture_of(ground)
    straight = Waypoints(np.array([0.0, 10.0]), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    room, ahead = forward_scene(ground)

    def still(pose: Floats) -> Waypoints:
        return Waypoints(np.zeros(1), pose[None])

    nadir = partial(view, scene, NADIR_CAMERA, BELOW)
    pincushion = pinhole(SIDE, SIDE, FOCAL_PX, distortion=(0.05, 0.01, 0.001, -0.001))
    barrel = pinhole(SIDE, SIDE, 1.6 * FOCAL_PX, distortion=(-0.28, 0.09, 0.001, -0.001))
    higher = Mount(np.array([0.0, 0.0, 1.6 * HEIGHT_M]))
    ours = {
        "nadir": (partial(nadir, DRIVE), lambda pose: nadir(still(pose), 0.0)),
        "rolling shutter": (
            partial(nadir, DRIVE, readout_s=0.01),
            lambda pose: nadir(still(pose), 0.0, readout_s=0.01),
        ),
        "pincushion": (partial(view, scene, pincushion, BELOW, DRIVE), None),
        "barrel, coarse": (partial(view, scene, barrel, higher, DRIVE), None),
        "relief": (partial(view, Scene(ground, relief=Relief(0.002, 0.05)), NADIR_CAMERA, BELOW, DRIVE), None),
        "twice as high": (partial(view, scene, NADIR_CAMERA, Mount(np.array([0, 0, 2 * HEIGHT_M])), DRIVE), None),
        "forward, room": (partial(view, room, pinhole(SIDE, SIDE, 400.0), ahead, straight), None),
    }
    rows = [
        Row(name, least_seconds(see, frames), *(bias(at) if at else (np.nan, np.nan)))
        for name, (see, at) in ours.items()
    ]
    peers = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC, "Lanczos4": cv2.INTER_LANCZOS4}
    for name, flag in peers.items():
        see = partial(warped, picture, flag)
        seconds = least_seconds(lambda t, see=see: see(DRIVE.at(np.array([t])).poses[0]), frames)
        rows.append(Row(f"cv2 {name}", seconds, *bias(see)))
    print(f"{'view':<18}{'ms/frame':>10}{'frames/s':>10}{'time ×':>9}{'S-curve mpx':>13}{'largest mpx':>13}")
    for r in rows:
        print(
            f"{r.name:<18}{1e3 * r.seconds:>10.2f}{1 / r.seconds:>10.0f}{r.seconds / rows[0].seconds:>9.2f}"
            f"{1e3 * r.s_curve_px:>13.2f}{1e3 * r.largest_px:>13.2f}"
        )


if __name__ == "__main__":
    main()
