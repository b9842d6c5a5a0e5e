"""Where the fragments and the photometric tiles of a frame lie."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.correlation.settings import CorrelationSettings
from pipelines.estimator import EstimatorError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SPAN_U, SPAN_V = 0.43, 0.586
"""Share of the image's width and height that the fragments span where the settings do not say."""


class Layout(NamedTuple):
    """Pixel centres (u, v) of F fragments and T tiles, and the same from the image centre.

    `centres` int64 [F, 2], `points` float64 [F, 2], `tile_centres` int64 [T, 2], `tile_points` float64 [T, 2];
    `centres_px`, `tile_centres_px` and `size_px` (width, height) are the same as float64, for the Steps.
    Fragments run along the rows from the rear (small u) to the front; the last of two is the front one.
    """

    centres: Integers
    points: Floats
    tile_centres: Integers
    tile_points: Floats
    centres_px: Floats
    tile_centres_px: Floats
    size_px: Floats
    no_tile_shift: Floats
    no_tile_weight: Floats


def layout_of(settings: CorrelationSettings, width: int, height: int) -> Layout:
    """The layout for an image of that size, in px.

    Raises:
        EstimatorError: the fragments do not fit into the image.
    """
    span_u = settings.span_u_px if settings.span_u_px is not None else round(SPAN_U * width)
    span_v = settings.span_v_px if settings.span_v_px is not None else round(SPAN_V * height)
    centre = np.array([width // 2, height // 2])
    u = _spread(settings.columns, span_u)
    v = _spread(settings.rows, span_v)
    centres = centre + np.array([(a, b) for b in v for a in u], dtype=np.int64)
    half = (settings.fragment_side_px - 1) // 2 + 1
    low, high = centres.min(axis=0), centres.max(axis=0)
    if (low < half).any() or high[0] >= width - half or high[1] >= height - half:
        raise EstimatorError(
            f"the fragments do not fit into an image of {width} x {height} px: they span "
            f"{high[0] - low[0]} x {high[1] - low[1]} px with sides of {settings.fragment_side_px} px; "
            "lower span_u_px, span_v_px or fragment_side_px"
        )
    margin = (settings.tile_side_px - 1) // 2 + 2
    tiles = np.array(
        [
            (a, b)
            for b in _between(settings.tile_rows, height, margin)
            for a in _between(settings.tile_columns, width, margin)
        ],
        dtype=np.int64,
    ).reshape(-1, 2)
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    layout = Layout(
        centres,
        centres - middle,
        tiles,
        tiles - middle,
        centres.astype(np.float64),
        tiles.astype(np.float64),
        np.array([width, height], np.float64),
        np.full(tiles.shape, np.nan),
        np.zeros(len(tiles)),
    )
    for shared in layout:
        shared.setflags(write=False)
    return layout


def _spread(count: int, span: float) -> list[int]:
    return [0] if count == 1 else [round(-span / 2 + span * i / (count - 1)) for i in range(count)]


def _between(count: int, size: int, margin: int) -> list[int]:
    if count == 0 or size <= 2 * margin:
        return []
    if count == 1:
        return [size // 2]
    return [round(margin + (size - 1 - 2 * margin) * i / (count - 1)) for i in range(count)]
