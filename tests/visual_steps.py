"""Steps of a visual odometry, for tests that look at a few of their fields."""

from typing import Any

import numpy as np

from pipelines.estimator import quantities
from pipelines.semidirect.step import Stage, VisualStep
from pipelines.verdict import Verdict


def visual_step(**fields: Any) -> VisualStep:
    """A tracked frame; what is not given is 0, NaN or empty."""
    values: dict[str, Any] = {"verdict": Verdict.OK, "alarms": Verdict.OK, "stage": int(Stage.TRACKED)}
    for name, declared in quantities(VisualStep).items():
        lengths = tuple(0 if isinstance(n, str) else n for n in declared["shape"])
        values.setdefault(name, np.full(lengths, np.nan) if declared["shape"] else 0)
    return VisualStep(**(values | fields))
