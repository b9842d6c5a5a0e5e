"""What the sources of landmarks share: frames in, image points of an ideal camera out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.lens import project, rays_where_known
from pipelines.ranging.sightings import Sighting
from readers.streams import Camera, ImageError, ImageSample, Problem, Sample, StreamKind

Grey = NDArray[np.uint8]
Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

NOTHING = Sighting(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0))


def is_frame(sample: Sample) -> bool:
    """Whether a sample is an image, or stands for one that could not be decoded."""
    return isinstance(sample, ImageSample) or (isinstance(sample, Problem) and sample.kind is StreamKind.IMAGE)


def grey_of(sample: Sample, camera: Camera) -> Grey | None:
    """The image as uint8 [height, width]; None where it cannot be decoded or has another size than the camera's.

    Of 16-bit images the eight bits from the highest one that the image uses, so that images of 10 or 12 bits keep
    their contrast.
    """
    if not isinstance(sample, ImageSample):
        return None
    try:
        grey = sample.grey()
    except ImageError:
        return None
    known = camera.width_px > 0 and camera.height_px > 0
    if known and grey.shape != (camera.height_px, camera.width_px):
        return None
    if grey.dtype != np.uint8:
        unused = max(int(grey.max(initial=0)).bit_length() - 8, 0)
        return np.ascontiguousarray(grey >> unused, dtype=np.uint8)
    return np.ascontiguousarray(grey, dtype=np.uint8)


def sighting(ids: Longs, points_px: Floats, sigma_px: Floats) -> Sighting:
    """Points [n, 2] with their noise [n], those that are not finite left out."""
    known = np.all(np.isfinite(points_px), axis=1)
    return Sighting(ids[known], points_px[known], sigma_px[known])


def ideal_px(camera: Camera, pixels: Floats) -> Floats:
    """Pixels [n, 2] as a camera without distortion and with square pixels would show them.

    That camera has the focal length K[0, 0] both ways and the principal point of K: the range filter has one focal
    length. NaN where the distortion model does not reach.
    """
    return np.asarray(camera.matrix[0, 0] * rays_where_known(camera, pixels)[:, :2] + camera.matrix[:2, 2])


def seen_px(camera: Camera, points_px: Floats) -> Floats:
    """The pixels [n, 2] at which the image shows points [n, 2] of the ideal camera: the inverse of `ideal_px`."""
    flat = (points_px - camera.matrix[:2, 2]) / camera.matrix[0, 0]
    return project(camera, np.column_stack([flat, np.ones(len(flat))]))
