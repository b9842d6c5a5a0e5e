"""Faults for the odometry: simulated missions with one fault each, and the rule that has to name it.

A mission is a short drive over flat ground. Its seed decides the ground, the way, when the fault begins and how
strong it is, within the range of the table below, in which the fault matters.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

Rng = np.random.Generator
FRAMES, RATE_HZ, SIDE_PX, SPEED_KMH = 120, 60.0, 288, 2.0
FAMILIES = ("gravel", "wood", "grass", "soil", "sand", "mud", "concrete", "street")
CURVES: Mapping[str, Mapping[str, Any]] = {
    "line": {},
    "circle": {"radius_m": 1.2},
    "serpentine": {"amplitude_m": 0.1, "wavelength_m": 2.0},
    "wander": {},
}
