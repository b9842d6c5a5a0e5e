"""Faults that lie on the ground: where, and when a camera meets them.

A patch covers the ground under the way while the fault lasts; the way may lead over it again. What counts
for a diagnosis is therefore computed from the geometry: when the image centre is over the patch, and when
any of the patch is in view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.lens import rays
from pipelines.simulation.channels import rng_of
from pipelines.simulation.faults import Fault, LowTexture, RepetitiveTexture
from pipelines.simulation.motion import Motion, Mount
from pipelines.simulation.scene import Patch
from pipelines.simulation.surfaces import Surface, surface_from_periodic, tiles
from readers.streams import Camera

Floats = NDArray[np.float64]
Rectangle = tuple[float, float, float, float]
"""x_min, x_max, y_min, y_max in the world, m."""

OF_GROUND = (RepetitiveTexture, LowTexture)
STEPS_S = 1e-3
JOINT_GREY, STRIPE_GREY = 100.0, 150.0
OnGround = RepetitiveTexture | LowTexture


def ground_points(camera: Camera, mount: Mount, motion: Motion, t_s: Floats, pixels: Floats) -> Floats:
    """Where rays through pixels [p, 2] of a camera meet z = 0: x, y in m [n, p, 2].

    A ray that does not go down gives infinity or no number.
    """
    world_r_camera, position = mount.world_t_camera(motion.at(t_s))
    ways = np.einsum("nij,pj->npi", world_r_camera, rays(camera, pixels))
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(ways[..., 2] < 0, -position[:, None, 2] / ways[..., 2], np.inf)
        points = position[:, None, :2] + reach[..., None] * ways[..., :2]
    return np.asarray(points)


def centres(camera: Camera, mount: Mount, motion: Motion, t_s: Floats) -> Floats:
    """Ground points of the image centre [n, 2]."""
    middle = np.array([[(camera.width_px - 1) / 2, (camera.height_px - 1) / 2]])
    return ground_points(camera, mount, motion, t_s, middle)[:, 0]


def corners(camera: Camera, mount: Mount, motion: Motion, t_s: Floats) -> Floats:
    """Ground points of the image's four corners, in order around it [n, 4, 2]."""
    return ground_points(camera, mount, motion, t_s, outline(camera))


def outline(camera: Camera) -> Floats:
    """The corners of the image, in order around it [4, 2]."""
    u, v = camera.width_px - 0.5, camera.height_px - 0.5
    return np.array([[-0.5, -0.5], [u, -0.5], [u, v], [-0.5, v]])


def faults_met(faults: Sequence[Fault], camera: Camera, mount: Mount, motion: Motion, t_s: Floats) -> tuple[Fault, ...]:
    """The faults of a mission as they really happen: those on the ground where and as often as they are met.

    Args:
        faults: as they were asked for.
        camera: the downward camera.
        mount: where it sits.
        motion: of the vehicle.
        t_s: times of its frames [n].

    Raises:
        ValueError: the way does not lead over a fault on the ground.
    """
    found: list[Fault] = []
    for fault in faults:
        if isinstance(fault, OF_GROUND):
            found += _met(fault, camera, mount, motion, t_s)
        else:
            found.append(fault)
    return tuple(found)


def _met(fault: OnGround, camera: Camera, mount: Mount, motion: Motion, t_s: Floats) -> tuple[OnGround, ...]:
    frame_s = float(t_s[1] - t_s[0]) if len(t_s) > 1 else 0.0
    area = fault.area_m
    if area is None:
        first, stop = np.searchsorted(t_s, [fault.start_s, fault.stop_s])
        if first == stop:
            raise ValueError(f"{fault.name}: there is no frame between {fault.start_s} and {fault.stop_s} s")
        times = np.arange(t_s[first] - frame_s / 2, t_s[stop - 1] + frame_s / 2, STEPS_S)
        area = rectangle_under(centres(camera, mount, motion, times), fault.margin_m)
    centre, corner = centres(camera, mount, motion, t_s), corners(camera, mount, motion, t_s)
    return met(fault, area, t_s, centre, corner, frame_s)


def patches_of(faults: Sequence[Fault], ground: Surface, seed: int) -> tuple[Patch, ...]:
    """The patches that faults of `faults_met` lay on the ground, each once."""
    areas: dict[Rectangle, OnGround] = {}
    for fault in faults:
        if isinstance(fault, OF_GROUND) and fault.area_m is not None:
            areas.setdefault(fault.area_m, fault)
    return tuple(Patch(_surface(fault, ground, seed), *area) for area, fault in areas.items())


def _surface(fault: OnGround, ground: Surface, seed: int) -> Surface:
    if isinstance(fault, LowTexture):
        return faded(ground, fault.gradient_rms)
    rng = rng_of(seed, fault.name, fault.pattern)
    joint_px, metres_per_px = max(1, fault.period_px // 4), ground.metres_per_px
    if fault.pattern == "tiles":
        return tiles(fault.period_px, rng, joint_px=joint_px, joint_grey=JOINT_GREY, metres_per_px=metres_per_px)
    stripe = np.full(fault.period_px, STRIPE_GREY)
    stripe[:joint_px] = JOINT_GREY
    return surface_from_periodic(np.tile(stripe, (fault.period_px, 1)), metres_per_px=metres_per_px)


def faded(ground: Surface, gradient_rms: float) -> Surface:
    """The same ground with so little contrast that the gradient along an axis has `gradient_rms` grey levels per px.

    At its knots the cubic spline's derivative is half the difference of the coefficients on both sides.
    """
    c = ground.coefficients.astype(np.float64)
    slopes = [(c[2:] - c[:-2]) / 2, (c[:, 2:] - c[:, :-2]) / 2]
    rms = ground.texels_per_px * float(np.sqrt(np.mean([np.mean(slope**2) for slope in slopes])))
    paler = (c.mean() + (c - c.mean()) * gradient_rms / rms).astype(np.float32)
    paler.setflags(write=False)
    return replace(ground, coefficients=paler)


def rectangle_under(points: Floats, margin_m: float) -> Rectangle:
    """The rectangle around a piece of way [n, 2], widened by `margin_m` to both sides of its main direction.

    Along the main direction it ends where the piece ends.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    across = int(np.ptp(points[:, 0]) >= np.ptp(points[:, 1]))
    low[across] -= margin_m
    high[across] += margin_m
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def met(
    fault: OnGround, area: Rectangle, t_s: Floats, centre: Floats, corner: Floats, frame_s: float
) -> tuple[OnGround, ...]:
    """The fault as often as the image centre comes over its area, with its true times.

    Args:
        fault: as it was asked for.
        area: the rectangle on the ground.
        t_s: times of the frames [n].
        centre: ground points of the image centre [n, 2].
        corner: ground points of the image corners [n, 4, 2].
        frame_s: time between frames.

    Raises:
        ValueError: the image centre never comes over the area.
    """
    over = [(first, stop) for first, stop in intervals(inside(area, centre), t_s, frame_s)]
    if not over:
        raise ValueError(f"{fault.name}: the way does not lead over it between {fault.start_s} and {fault.stop_s} s")
    view = tuple(intervals(overlaps(area, corner), t_s, frame_s))
    return tuple(replace(fault, start_s=first, stop_s=stop, area_m=area, in_view_s=view) for first, stop in over)


def inside(area: Rectangle, points: Floats) -> NDArray[np.bool_]:
    """Whether points [n, 2] lie in a rectangle [n]."""
    x, y = points[:, 0], points[:, 1]
    return np.asarray((area[0] <= x) & (x < area[1]) & (area[2] <= y) & (y < area[3]))


def overlaps(area: Rectangle, quads: Floats) -> NDArray[np.bool_]:
    """Whether convex quadrangles [n, 4, 2] and a rectangle have a point in common [n].

    Two convex shapes are apart if and only if they are apart along a normal of one of their edges.
    """
    x_min, x_max, y_min, y_max = area
    box = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]])
    edges = np.roll(quads, -1, axis=1) - quads
    normals = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    axes = np.concatenate([normals, np.broadcast_to(np.eye(2), (len(quads), 2, 2))], axis=1)
    ours, theirs = axes @ np.swapaxes(quads, 1, 2), axes @ box.T
    apart = (ours.max(axis=2) < theirs.min(axis=2)) | (theirs.max(axis=2) < ours.min(axis=2))
    return np.asarray(~apart.any(axis=1))


def intervals(held: NDArray[np.bool_], t_s: Floats, frame_s: float) -> Sequence[tuple[float, float]]:
    """The intervals of time of the frames that are `held` [n], each from its first frame to the one after."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(np.int8)))
    ends = np.append(t_s, t_s[-1] + frame_s) if len(t_s) else t_s
    return [(float(ends[a]), float(ends[b])) for a, b in edges.reshape(-1, 2)]
