"""Columns made of arrays: the very columns that Rerun's own constructors make."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr

from workbench.rrd_columns import blobs, columns, lists, own_columns, repeated
from workbench.traces import Joined

RNG = np.random.default_rng(5)
N = 6
COUNTS = np.array([2, 0, 1, 3, 0, 0])
POINTS_2D, POINTS_3D = RNG.normal(size=(N, 2)), RNG.normal(size=(N, 3))
COLOURS = RNG.integers(0, 2**32, N, dtype=np.uint32)
STRIPS_2D, STRIPS_3D = RNG.normal(size=(N, 4, 2)), RNG.normal(size=(N, 4, 3))
TEXTS = ["a", "", "ξ", "d", "e", "f"]


def parts(made: Any) -> list[tuple[rr.ComponentDescriptor, pa.Array]]:
    found = [(one.component_descriptor(), one.as_arrow_array()) for one in made]
    return sorted(found, key=lambda part: str(part[0].component))


def assert_alike(ours: Any, theirs: Any) -> None:
    pairs = list(zip(parts(ours), parts(theirs), strict=True))
    assert pairs
    for (descriptor, values), (expected, reference) in pairs:
        assert descriptor == expected
        assert values.type == reference.type
        assert values.equals(reference) or repr(values.to_pylist()) == repr(reference.to_pylist())  # NaN is like NaN


@pytest.mark.parametrize(
    ("archetype", "components"),
    [
        (rr.Scalars, {"scalars": np.array([1.0, np.nan, -0.0, np.inf, 1e300, 5e-324])}),
        (rr.Points2D, {"positions": POINTS_2D, "colors": COLOURS, "labels": TEXTS}),
        (rr.Points2D, {"positions": POINTS_2D.astype(np.float32), "radii": -POINTS_2D[:, 0]}),
        (rr.Points3D, {"positions": POINTS_3D, "colors": COLOURS, "radii": POINTS_3D[:, 0].astype(np.float32)}),
        (rr.Boxes2D, {"centers": POINTS_2D, "half_sizes": POINTS_2D, "colors": COLOURS}),
        (rr.Arrows2D, {"origins": POINTS_2D, "vectors": POINTS_2D}),
        (rr.Arrows3D, {"vectors": POINTS_3D, "origins": POINTS_3D}),
        (
            rr.Ellipsoids3D,
            {"half_sizes": POINTS_3D, "centers": POINTS_3D, "quaternions": RNG.normal(size=(N, 4)), "colors": COLOURS},
        ),
        (rr.LineStrips2D, {"strips": STRIPS_2D.astype(np.float32), "colors": COLOURS}),
        (rr.LineStrips3D, {"strips": STRIPS_3D.astype(np.float32)}),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else "",
)
def test_columns_are_those_of_the_archetype(archetype: Any, components: dict[str, Any]) -> None:
    theirs = archetype.columns(**components)
    assert_alike(columns(archetype, **components), theirs)
    assert_alike(columns(archetype, COUNTS, **components), theirs.partition(COUNTS))


@pytest.mark.parametrize(
    ("archetype", "components"),
    [
        (rr.TextDocument, {"text": TEXTS}),
        (rr.TextLog, {"text": TEXTS, "level": ["INFO"] * N}),
        (rr.StateChange, {"state": TEXTS}),
        (rr.Clear, {"is_recursive": [False] * N}),
        (rr.Points2D, {"show_labels": np.array([True, False] * 3)}),
        (rr.Transform3D, {"translation": POINTS_3D, "quaternion": RNG.normal(size=(N, 4))}),
        (rr.EncodedImage, {"blob": blobs([b"abc", b"", memoryview(b"de")]), "media_type": ("image/png",) * 3}),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else "",
)
def test_columns_of_texts_and_single_values_are_those_of_the_archetype(
    archetype: Any, components: dict[str, Any]
) -> None:
    given = {name: list(values) if isinstance(values, tuple) else values for name, values in components.items()}
    assert_alike(columns(archetype, **components), archetype.columns(**given))


def test_rows_of_several_scalars() -> None:
    values = RNG.normal(size=(N, 6))[:, 1:4]
    theirs = rr.Scalars.columns(scalars=values.ravel()).partition(np.full(N, 3))
    assert_alike(columns(rr.Scalars, scalars=values), theirs)


def test_no_rows() -> None:
    assert [len(values) for _, values in parts(columns(rr.Points2D, positions=np.empty((0, 2))))] == [0]
    none = parts(columns(rr.Points2D, np.zeros(N, int), positions=np.empty((0, 2)), colors=np.empty(0, np.uint32)))
    assert [values.to_pylist() for _, values in none] == [[[]] * N] * 2


def test_buffers_keep_every_byte() -> None:
    pixels = RNG.integers(0, 256, (N, 7), dtype=np.uint8)
    (buffer,) = parts(columns(rr.DepthImage, buffer=pixels))
    assert [bytes(row[0]) for row in buffer[1].to_pylist()] == [row.tobytes() for row in pixels]
    (other,) = parts(columns(rr.DepthImage, buffer=blobs(list(pixels))))
    assert other[1].equals(buffer[1])
    assert other[1].type == parts(rr.DepthImage.columns(buffer=blobs(list(pixels))))[0][1].type


def test_repeated_rows() -> None:
    form = rr.components.ImageFormat(width=3, height=2, color_model="L", channel_datatype="F16")
    assert_alike(repeated(rr.DepthImage, 3, format=form), rr.DepthImage.columns(format=[form] * 3))
    theirs = rr.TextDocument.columns(media_type=["text/markdown"] * 3)
    assert_alike(repeated(rr.TextDocument, 3, media_type="text/markdown"), theirs)


def test_columns_of_our_own() -> None:
    components = {"whole": np.arange(N), "large": [7, 8, 9, 2**60, -1, 0], "texts": TEXTS, "real": POINTS_2D[:, 0]}
    theirs = rr.DynamicArchetype.columns("Own", components=components)
    assert_alike(own_columns("Own", components), theirs)
    assert_alike(own_columns("Own", components, COUNTS), theirs.partition(COUNTS))


def test_lists_of_pairs() -> None:
    joined = Joined(COUNTS, POINTS_2D)
    (ours,) = parts(lists("Own", {"values": joined}))
    assert ours[1].to_pylist() == [part.ravel().tolist() for part in np.split(POINTS_2D, np.cumsum(COUNTS)[:-1])]
    (none,) = parts(lists("Own", {"values": Joined(np.zeros(2, np.int64), np.empty((0, 2)))}))
    assert none[1].to_pylist() == [[], []]
    assert none[1].type == ours[1].type
