"""Every field of a Step has its place in the recording, and nothing else has."""

import dataclasses
from collections import Counter
from pathlib import Path

import pytest

from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step, quantities
from readers.streams import WorkbenchError
from workbench.schema import SCHEMAS, Archetype, Schema, document, schema_of

EVERY = pytest.mark.parametrize("schema", SCHEMAS.values(), ids=lambda s: s.step_type.__name__)


@EVERY
def test_every_field_has_one_row_and_no_row_lacks_a_field(schema: Schema) -> None:
    rows = Counter(row.field for row in schema.rows)
    assert rows == Counter(f.name for f in dataclasses.fields(schema.step_type))


@EVERY
def test_axes_match_the_declared_shapes(schema: Schema) -> None:
    declared = quantities(schema.step_type)
    for row in schema.rows:
        fixed = [n for n in declared[row.field]["shape"] if isinstance(n, int)]
        if row.axes:
            product = 1
            for n in fixed:
                product *= n
            assert len(row.axes) == product, row.field


@EVERY
def test_a_field_of_open_length_has_its_entity_to_itself(schema: Schema) -> None:
    for rows in schema.of(Archetype.SCALARS).values():
        free = [row for row in rows if any(isinstance(n, str) for n in schema.shape(row.field))]
        assert not free or len(rows) == 1


def test_series_carry_title_axis_unit_and_fragment() -> None:
    schema = schema_of(CorrelationStep)
    names = [s.name for s in schema.series("subpixel/delta", 4)]
    assert names == ["Δ 1 u [px]", "Δ 1 v [px]", "Δ 2 u [px]", "Δ 2 v [px]"]
    assert [s.name for s in schema.series("pose/raw", 3)] == ["raw x [m]", "raw y [m]", "raw heading [rad]"]
    assert [s.name for s in schema.series("fit/inliers", 1)] == ["inliers"]
    covariance = schema.series("pose/covariance", 9)
    assert covariance[2].name == "pose P xα"
    assert len({s.colour for s in covariance}) == 9


def test_a_step_class_without_rows_is_refused_by_name() -> None:
    with pytest.raises(WorkbenchError, match=r"Step: no schema .* workbench/schema.py"):
        schema_of(Step)


def test_the_page_is_current() -> None:
    page = Path(__file__).parents[1] / "docs" / "schema.md"
    assert page.read_text(encoding="utf-8") == document(), "run python -m workbench.schema"
