"""The range filter's table of planted failures, for `workbench.diagnosis.scoring`.

What is called a preset there is the filter's mode here: ``best`` (which is ``independent``) or ``joint``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from workbench.diagnosis.range_missions import CLEAN, MISSIONS, UNSEEN, replayed
from workbench.diagnosis.scoring import Planted, Trial

MODES: Mapping[str, str] = {"best": "independent", "joint": "joint"}

STRENGTHS: Mapping[str, str] = {
    CLEAN: "",
    "near-focus": "within 2 px of the focus at the start",
    "pure-rotation": "0.6…1 rad on the spot in 3…5 s, at the start or amidst",
    "standstill": "2.5…5 s",
    "overconfident-start": "0.3…0.45 or 2.5…4 times the median range, σ 2…6 % of it",
    "measurement-noise-too-small": "σ of R 2.2…5 times too small",
    "measurement-noise-too-large": "σ of R 2.2…5 times too large",
    "input-noise-too-small": "gyro 6e-3…1.2e-2 rad/s/√Hz; told 5…20 times less, or 0",
    "dropped-frames": "0.4…1.5 s",
    "dropped-motion": "0.4…1.5 s, images and inputs",
    "late-images": "40…200 ms for 5…8 s, headings swing by 0.1…0.18 rad in 3…5 s",
    "swapped-stamps": "1…3 s",
    "wrong-mounting": "principal point or pitch 6…15 px, yaw 12…20 px",
    "gyro-bias": "0.006…0.02 rad/s, always or for 6…9 s",
    "track-outliers": "5…30 % of the points by up to 25…60 px for 1…4 s",
    "track-slip": "8…30 px for 3…6 s",
    "missing-inputs": "gyro, odometer or both for 0.6…2 s",
    "odometer-scale": "5…12 %, with reference depths",
    UNSEEN: "5…12 %",
}

LEFT_OUT: Mapping[str, str] = {
    "odometer-scale without a reference": "every range is off by the same share, and no number inside the filter knows",
    "σ_V too small": "the errors of the speed are common to all landmarks: NIS does not show them",
}


def trial(failure: str, mode: str, seed: int) -> Trial:
    """The mission of a failure and a seed, replayed."""
    made = replayed(failure, seed, mode=mode)
    return Trial(made.case, np.isin(made.case.frame, made.wrong))


def planted(preset: str = "best") -> tuple[Planted, ...]:
    """The failures of the range filter, and the rules that have to name them."""
    return tuple(
        Planted(
            fault=name,
            rule=name if name in MISSIONS else "",
            trial=partial(trial, name, MODES[preset]),
            strength=strength,
        )
        for name, strength in STRENGTHS.items()
    )
