"""What numbers on the ground look like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

UNSEEN = (18, 20, 24)


@dataclass(frozen=True, slots=True)
class Scale:
    """A scale of colours: from `low`, blue, to `high`, yellow."""

    low: float
    high: float

    @classmethod
    def of_counts(cls, count: NDArray[Any]) -> Scale:
        """From none to what only one of a hundred seen cells has more of."""
        return cls(0.0, max(float(np.quantile(count[count > 0], 0.99)), 2.0) if (count > 0).any() else 2.0)

    @classmethod
    def of_sizes(cls, sizes: Floats) -> Scale:
        """Of all but the smallest and the largest hundredth."""
        low, high = np.quantile(sizes, [0.01, 0.99]).tolist()
        return cls(low, high)

    def colours(self, numbers: Floats) -> NDArray[np.uint8]:
        """RGB [rows, columns, 3]; where NaN, the background."""
        share = np.clip((numbers - self.low) / max(self.high - self.low, 1e-12), 0, 1)
        grey = np.nan_to_num(share * 255).astype(np.uint8)
        rgb = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
        rgb[~np.isfinite(numbers)] = UNSEEN
        return np.asarray(rgb, dtype=np.uint8)
