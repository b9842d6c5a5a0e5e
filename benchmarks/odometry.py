"""Our odometry beside three peers, on the same decoded frames in the same process.

    python benchmarks/odometry.py [--frames 300] [--image PICTURE | --gravel] [--speed 0.51]

The frames are those of a simulated drive along the paper's figure eight, so that the truth is exact.
Every method measures the motion between consecutive frames; for the peers it is integrated exactly.
Time is CPU time of the one thread that works, decoding excluded: of each frame the least of several passes (other
programs disturb some of them), of these the mean over the frames (so that a key frame counts with what it costs).

Peers:

- PyrLK: 200 corners (Shi-Tomasi), cv2.calcOpticalFlowPyrLK, similarity by cv2.estimateAffinePartial2D;
- PyrLK tuned: the same with corners moved off the pixel grid and RANSAC at 0.3 px instead of 3;
- ORB: 500 features, brute-force matching with cross check, similarity by RANSAC (3 px);
- phase: cv2.phaseCorrelate of the front and the rear half, 256 x 256 each.

Shifts are those of the image content at the image centre, in px in the axes of the later frame; turns are
counter-clockwise positive.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import CorrelationSettings
from pipelines.simulation.mission import IMAGE, SimulatedMission, nadir_mission
from pipelines.simulation.surfaces import Surface, gravel, surface_from_image
from pipelines.simulation.trajectories import drive, figure_eight, image_motion
from readers.streams import ImageSample

Floats = NDArray[np.float64]
Frames = Sequence[NDArray[np.uint8]]

RECORDINGS = Path(os.environ.get("WORKBENCH_RECORDINGS", Path(__file__).parents[1].parent / "shared" / "recordings"))
GRAVEL = RECORDINGS / "paper_a_surface_frames" / "b_01.png"
LENGTH_PX, HALF_PX = 200, 256  # distance and side of the two halves of phase correlation
WARM_UP = 5
PASSES = 5


class Measured(NamedTuple):
    """Motions between consecutive frames: shift px [n, 2], turn rad [n], CPU seconds [n]; NaN where it failed."""

    shift_px: Floats
    turn_rad: Floats
    seconds: Floats


class Row(NamedTuple):
    """One line of the table; rms values are those of the frames that did not fail."""

    name: str
    micros: float
    failed_percent: float
    shift_px: float
    turn_mrad: float
    end_percent: float
    yaw_deg: float


# ----------------------------------------------------------------------------------- peers

Motion = tuple[float, float, float]  # shift u, shift v, turn
FAILED: Motion = (float("nan"),) * 3  # type: ignore[assignment]


def peer_pyrlk(frames: Frames, *, tuned: bool = False) -> Measured:
    """200 corners tracked by pyramidal Lucas-Kanade, similarity by RANSAC.

    Where it is tuned, the points are moved off the pixel grid at random: on it, the bilinear interpolation
    of the later frame alone biases all of them alike, which triples the heading error.
    """
    offsets = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 1, 2)).astype(np.float32)

    def motion(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> Motion:
        corners = cv2.goodFeaturesToTrack(before, maxCorners=200, qualityLevel=0.01, minDistance=10)
        if corners is None:
            return FAILED
        if tuned:
            corners = corners + offsets[: len(corners)]
        tracked, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, winSize=(21, 21), maxLevel=3)
        good = found.ravel() == 1
        return of_similarity(corners[good], tracked[good], before.shape, inlier_px=0.3 if tuned else 3.0)

    return over_pairs(frames, motion)


def peer_orb(frames: Frames) -> Measured:
    """500 ORB features, matched both ways by brute force, similarity by RANSAC."""
    orb = cv2.ORB_create(nfeatures=500)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    last: dict[int, tuple[Sequence[cv2.KeyPoint], NDArray[np.uint8] | None]] = {}

    def described(frame: NDArray[np.uint8]) -> tuple[Sequence[cv2.KeyPoint], NDArray[np.uint8] | None]:
        return last[id(frame)] if id(frame) in last else orb.detectAndCompute(frame, None)

    def motion(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> Motion:
        (points0, codes0), (points1, codes1) = described(before), described(after)
        last.clear()
        last[id(after)] = points1, codes1
        if codes0 is None or codes1 is None:
            return FAILED
        matches = matcher.match(codes0, codes1)
        start = np.array([points0[m.queryIdx].pt for m in matches], dtype=np.float32).reshape(-1, 2)
        end = np.array([points1[m.trainIdx].pt for m in matches], dtype=np.float32).reshape(-1, 2)
        return of_similarity(start, end, before.shape, inlier_px=3.0)

    return over_pairs(frames, motion)


def peer_phase(frames: Frames) -> Measured:
    """Phase correlation of a front and a rear window; their difference gives the turn."""
    window = cv2.createHanningWindow((HALF_PX, HALF_PX), cv2.CV_32F)

    def halves(frame: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
        rows, columns = frame.shape
        top = (rows - HALF_PX) // 2
        lefts = [(columns + offset - HALF_PX) // 2 for offset in (LENGTH_PX, -LENGTH_PX)]
        return [frame[top : top + HALF_PX, left : left + HALF_PX].astype(np.float32) for left in lefts]

    def motion(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> Motion:
        pairs = zip(halves(before), halves(after), strict=True)
        (u1, v1), (u2, v2) = (cv2.phaseCorrelate(a, b, window)[0] for a, b in pairs)
        return (u1 + u2) / 2, (v1 + v2) / 2, float(np.arctan2(v1 - v2, LENGTH_PX + u1 - u2))

    return over_pairs(frames, motion)


def of_similarity(
    start: NDArray[np.float32], end: NDArray[np.float32], shape: tuple[int, ...], inlier_px: float
) -> Motion:
    """Shift of the image centre and turn of the similarity that maps points [n, 2] to points [n, 2]."""
    if len(start) < 3:
        return FAILED
    matrix, _ = cv2.estimateAffinePartial2D(start, end, method=cv2.RANSAC, ransacReprojThreshold=inlier_px)
    if matrix is None:
        return FAILED
    centre = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    shift = matrix @ [*centre, 1] - centre
    # the content turns clockwise on the screen (+u towards +v) when the camera turns counter-clockwise
    return float(shift[0]), float(shift[1]), float(np.arctan2(matrix[1, 0], matrix[0, 0]))


def over_pairs(frames: Frames, motion: Callable[[NDArray[np.uint8], NDArray[np.uint8]], Motion]) -> Measured:
    """Measure every pair of consecutive frames, after a few pairs to warm up."""
    for before, after in pairwise(frames[:WARM_UP]):
        motion(before, after)
    cv2.setRNGSeed(0)
    found, seconds = [], []
    for before, after in pairwise(frames):
        start = time.thread_time()
        found.append(motion(before, after))
        seconds.append(time.thread_time() - start)
    motions = np.array(found)
    return Measured(motions[:, :2], motions[:, 2], np.array(seconds))


# ------------------------------------------------------------------------------------ ours


def ours(preset: str, samples: Sequence[ImageSample], metres_per_px: float, start: Floats) -> tuple[Measured, Floats]:
    """Run our estimator; returns its motions and its own poses [n, 3]."""
    values = CorrelationSettings.preset(preset).model_dump()
    values |= {"metres_per_px": metres_per_px, "start_pose": tuple(float(x) for x in start)}
    odometry = CorrelationOdometry(CorrelationSettings(**values))
    state = odometry.start()
    for sample in samples[: 10 * WARM_UP]:  # far enough for every kernel to be compiled
        state, _ = odometry.step(state, sample)
    state, steps, seconds = odometry.start(), [], []
    for sample in samples:
        begin = time.thread_time()
        state, step = odometry.step(state, sample)
        seconds.append(time.thread_time() - begin)
        steps.append(step)
    shift = np.array([step.frame_shift_px for step in steps[1:]])
    turn = np.array([step.delta_heading_rad for step in steps[1:]])
    return Measured(shift, turn, np.array(seconds[1:])), np.array([step.pose for step in steps])


# ------------------------------------------------------------------------------- judgement


def integrated(measured: Measured, metres_per_px: float, start: Floats) -> Floats:
    """Poses [n + 1, 3] by exact integration; a failed frame stands still."""
    shift, turn = np.nan_to_num(measured.shift_px), np.nan_to_num(measured.turn_rad)
    heading = start[2] + np.concatenate([[0], np.cumsum(turn)])
    cos, sin = np.cos(heading[1:]), np.sin(heading[1:])
    steps = -metres_per_px * np.column_stack(
        [cos * shift[:, 0] + sin * shift[:, 1], sin * shift[:, 0] - cos * shift[:, 1]]
    )
    return np.column_stack([start[:2] + np.concatenate([[[0, 0]], np.cumsum(steps, axis=0)]), heading])


def judged(name: str, measured: Measured, poses: Floats, truth: Floats, metres_per_px: float) -> Row:
    """Compare motions and poses with the truth; more than 1 px off is a failure."""
    shift, turn = image_motion(truth, metres_per_px)
    off, twist = measured.shift_px - shift, measured.turn_rad - turn
    good = np.hypot(off[:, 0], off[:, 1]) <= 1
    path = np.linalg.norm(np.diff(truth[:, :2], axis=0), axis=1).sum()
    yaw = (poses[:, 2] - truth[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return Row(
        name=name,
        micros=float(1e6 * np.mean(measured.seconds)),
        failed_percent=float(100 * np.mean(~good)),
        shift_px=float(np.sqrt(np.mean(off[good] ** 2))) if good.any() else float("nan"),
        turn_mrad=float(1e3 * np.sqrt(np.mean(twist[good] ** 2))) if good.any() else float("nan"),
        end_percent=float(100 * np.linalg.norm(poses[-1, :2] - truth[-1, :2]) / path),
        yaw_deg=float(np.degrees(np.sqrt(np.mean(yaw**2)))),
    )


def print_table(rows: Sequence[Row]) -> None:
    """Print the rows and, for the peers, what they cost and err compared with our two presets."""
    head = f"{'method':<14}{'µs/frame':>10}{'frames/s':>10}{'failed %':>10}{'shift px':>10}{'Δα mrad':>10}"
    print(head + f"{'end %':>9}{'yaw rms deg':>13}")
    for r in rows:
        print(
            f"{r.name:<14}{r.micros:>10.0f}{1e6 / r.micros:>10.0f}{r.failed_percent:>10.1f}{r.shift_px:>10.4f}"
            f"{r.turn_mrad:>10.4f}{r.end_percent:>9.3f}{r.yaw_deg:>13.4f}"
        )
    for mine in rows[:2]:
        print(f"\ncompared with {mine.name}: time ×, Δα error ×, end error ×, yaw error ×")
        for r in rows[2:]:
            pairs = [(r.micros, mine.micros), (r.turn_mrad, mine.turn_mrad), (r.end_percent, mine.end_percent)]
            ratios = [theirs / own for theirs, own in [*pairs, (r.yaw_deg, mine.yaw_deg)]]
            print(f"{r.name:<14}" + "".join(f"{x:>10.2f}" for x in ratios))


def ground(arguments: argparse.Namespace) -> Surface:
    """The surface that was asked for."""
    if arguments.gravel:
        return gravel(1024, np.random.default_rng(arguments.seed))
    picture = cv2.imread(str(arguments.image))
    if picture is None:
        raise SystemExit(f"{arguments.image}: no picture could be read; name one with --image, or take --gravel")
    return surface_from_image(picture.astype(np.float64) @ [0.114, 0.587, 0.299])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300, help="number of frames")
    parser.add_argument("--image", type=Path, default=GRAVEL, help="picture that the ground is made of")
    parser.add_argument("--gravel", action="store_true", help="take our own procedural gravel instead")
    parser.add_argument("--speed", type=float, default=0.51, help='m/s; 0.51 is the paper\'s "2 km/h"')
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation of the noise, grey levels")
    parser.add_argument("--seed", type=int, default=0, help="seed of drive, noise and gravel")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)

    rng = np.random.default_rng(arguments.seed)
    truth = drive(figure_eight(), arguments.frames, speed_mps=arguments.speed, rng=rng)
    mission = nadir_mission(ground(arguments), truth, noise_grey=arguments.noise, seed=arguments.seed)
    frames = [mission.frame(k) for k in range(arguments.frames)]
    samples = decoded_samples(mission, frames)
    scale = mission.metres_per_px

    def theirs(peer: Callable[[Frames], Measured]) -> tuple[Measured, Floats]:
        measured = peer(frames)
        return measured, integrated(measured, scale, truth[0])

    methods = {
        "best": partial(ours, "best", samples, scale, truth[0]),
        "paper-a": partial(ours, "paper-a", samples, scale, truth[0]),
        "PyrLK 200": partial(theirs, peer_pyrlk),
        "PyrLK tuned": partial(theirs, partial(peer_pyrlk, tuned=True)),
        "ORB 500": partial(theirs, peer_orb),
        "phase 2x256": partial(theirs, peer_phase),
    }
    # the methods take turns, so that a disturbance does not fall on all passes of one of them
    turns = [{name: method() for name, method in methods.items()} for _ in range(PASSES)]
    rows = []
    for name in methods:
        measured, poses = turns[0][name]
        least = np.min([turn[name][0].seconds for turn in turns], axis=0)
        rows.append(judged(name, measured._replace(seconds=least), poses, truth, scale))
    print(f"{'gravel' if arguments.gravel else arguments.image.name}, {arguments.frames} frames of 512 x 512\n")
    print_table(rows)


def decoded_samples(mission: SimulatedMission, frames: Frames) -> list[ImageSample]:
    """The mission's image samples with their bytes in memory, so that nothing is rendered while timing."""
    return [
        ImageSample(
            stream=IMAGE,
            t_ns=int(t_ns),
            received_ns=int(t_ns),
            encoding="mono8",
            payload=frame.data.cast("B"),
            width_px=frame.shape[1],
            height_px=frame.shape[0],
            step_bytes=frame.shape[1],
        )
        for t_ns, frame in zip(mission.truth_t_ns, frames, strict=True)
    ]


if __name__ == "__main__":
    main()
