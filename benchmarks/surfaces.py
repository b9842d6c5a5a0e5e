"""How hard the simulated grounds are to match, and how fast they are rendered.

    python benchmarks/surfaces.py [--pairs 20] [--seeds 3] [--picture PATH]

For every family of `pipelines.simulation.families`: the share of N x N fragments (N = 9, 15, 21, 31) whose best match
in the next frame is a false one; then the least CPU time of a frame of 512 x 512, with and without a scatter.
`--picture` also draws the nine families, 512 x 512 px each.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.correlation.kernels import correlation_surface
from pipelines.simulation.families import PAPER_GROUNDS, ground
from pipelines.simulation.mission import PAPER_HEIGHT_M, nadir_camera
from pipelines.simulation.render import expose, noise_key_of, radiance, world_h_pixel
from pipelines.simulation.surfaces import Surface

SIDES = (9, 15, 21, 31)
RADIUS_PX, NOISE_GREY, TURN_RAD, FALSE_PX = 16, 2.0, np.deg2rad(0.44), 1.5
FRAME = (512, 512)
MATRIX = nadir_camera().matrix


def false_peaks(surface: Surface, sides: Sequence[int], *, pairs: int = 20, seed: int = 0) -> NDArray[np.float64]:
    """Share of fragments, for each side N, whose best integer match is more than 1.5 px off (study, 4.1).

    24 fragments in each of so many pairs of frames: anywhere, 0.44° and up to 11 px a axis apart, noise of 2 grey
    levels, searched within ±16 px of where they were.
    """
    rng = np.random.default_rng(seed)
    wrong = np.zeros(len(sides))
    for pair in range(pairs):
        pose = np.append(rng.uniform(-3, 3, 2), rng.uniform(-np.pi, np.pi))
        moved = pose + np.append(rng.uniform(-11, 11, 2) * surface.metres_per_px, rng.choice([-1, 1]) * TURN_RAD)
        ways = [world_h_pixel(p, MATRIX, PAPER_HEIGHT_M) for p in (pose, moved)]
        before, after = (
            expose(radiance(surface, way, FRAME), noise_key=noise_key_of(seed, 2 * pair + k), noise_grey=NOISE_GREY)
            for k, way in enumerate(ways)
        )
        for u, v in rng.integers(60, 452, (24, 2)):
            x, y, depth = np.linalg.inv(ways[1]) @ ways[0] @ [u, v, 1]
            for k, side in enumerate(sides):
                found = _best_match(before, after, u, v, side)
                wrong[k] += np.hypot(found[0] - x / depth, found[1] - y / depth) > FALSE_PX
    return wrong / (24 * pairs)


def _best_match(before: NDArray[np.uint8], after: NDArray[np.uint8], u: int, v: int, side: int) -> tuple[int, int]:
    half = side // 2
    template = before[v - half : v + half + 1, u - half : u + half + 1]
    correlation = np.empty((2 * RADIUS_PX + 1, 2 * RADIUS_PX + 1), np.float32)
    correlation_surface(template, after, u, v, RADIUS_PX, correlation)
    j, i = np.unravel_index(np.argmax(correlation), correlation.shape)
    return u + int(i) - RADIUS_PX, v + int(j) - RADIUS_PX


def frame_ms(surface: Surface, passes: int = 30) -> float:
    """Least CPU time (ms) of a rendered and exposed frame, over frames at different places."""
    times = []
    for k in range(passes):
        way = world_h_pixel(np.array([0.05 * k, 0.03 * k, 0.4]), MATRIX, PAPER_HEIGHT_M)
        start = time.process_time()
        expose(radiance(surface, way, FRAME), noise_key=k, noise_grey=NOISE_GREY)
        times.append(time.process_time() - start)
    return 1e3 * min(times)


def draw(path: str) -> None:
    """The nine families in rows of three, each named."""
    views = []
    for name in PAPER_GROUNDS:
        way = world_h_pixel(np.array([0.31, 0.12, 0.0]), MATRIX, PAPER_HEIGHT_M)
        view = np.clip(radiance(ground(name, seed=1), way, FRAME), 0, 255).astype(np.uint8)
        cv2.rectangle(view, (0, 0), (22 + 15 * len(name), 38), 0, -1)
        cv2.putText(view, name, (10, 27), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2, cv2.LINE_AA)
        views.append(view)
    picture = np.vstack([np.hstack(views[k : k + 3]) for k in (0, 3, 6)])
    cv2.imwrite(path, cv2.resize(picture, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--picture")
    options = parser.parse_args()
    print("false matches in %   " + "".join(f"N = {side:<5d}" for side in SIDES))
    for name in PAPER_GROUNDS:
        rates = [false_peaks(ground(name, seed=s), SIDES, pairs=options.pairs, seed=s) for s in range(options.seeds)]
        print(f"{name:21}" + "".join(f"{100 * rate:<9.1f}" for rate in np.mean(rates, axis=0)))
    for label, scatter in (("without", False), ("with", True)):
        print(f"frame {label} scatter: {frame_ms(ground('sand', scatter=scatter)):.1f} ms")
    if options.picture:
        draw(options.picture)


if __name__ == "__main__":
    main()
