"""What is believed of n landmarks: each by itself, or all together with the speeds' shared noise.

Both are values with the same methods, so that the estimator does not mind which one it carries. A landmark's mean is
x, y, ξ (px, px, 1/m).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import equations as eq
from pipelines.ranging import filter as separate
from pipelines.ranging import joint
from pipelines.ranging.filter import UPPER, Inputs, Landmarks, Update
from pipelines.ranging.joint import Joint
from pipelines.ranging.settings import Model
from pipelines.ranging.start import Start

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

NO_TIME = Inputs(0.0, 0.0, 0.0)


class Belief(Protocol):
    """Means and covariances of n landmarks."""

    @property
    def mean(self) -> Floats:
        """X [n, 3]."""
        ...

    @property
    def blocks(self) -> Floats:
        """P of each landmark [n, 3, 3]."""
        ...

    def only(self, kept: Longs) -> Self:
        """Some of the landmarks, by number."""
        ...

    def and_also(self, starts: Sequence[Start]) -> Self:
        """These landmarks, followed by new ones."""
        ...

    @property
    def pairs(self) -> Floats:
        """P of each landmark with each other [n, n, 3, 3], or with itself alone [n, 1, 3, 3]."""
        ...

    def carried(self, ahead: Floats, pairs: Floats) -> Self:
        """Another mean [n, 3] and covariance (see `pairs`) of the same landmarks."""
        ...

    def updated(self, model: Model, pixel: Floats, variance: Floats) -> tuple[Self, Update]:
        """The update (25)-(27) with image points [n, 2], NaN for none, of variance [n], px²."""
        ...


@dataclass(frozen=True, slots=True)
class Separate:
    """Independent filters: mean [n, 3], covariance [n, 3, 3], rejections in a row [n]."""

    mean: Floats
    blocks: Floats
    rejections: Longs

    @classmethod
    def none(cls) -> Separate:
        """No landmark."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64))

    def only(self, kept: Longs) -> Separate:
        """See `Belief`."""
        return Separate(self.mean[kept], self.blocks[kept], self.rejections[kept])

    def and_also(self, starts: Sequence[Start]) -> Separate:
        """See `Belief`."""
        return Separate(
            np.concatenate([self.mean, np.array([s.state for s in starts]).reshape(-1, 3)]),
            np.concatenate([self.blocks, np.array([s.covariance for s in starts]).reshape(-1, 3, 3)]),
            np.concatenate([self.rejections, np.zeros(len(starts), np.int64)]),
        )

    @property
    def pairs(self) -> Floats:
        """See `Belief`."""
        return self.blocks[:, None]

    def carried(self, ahead: Floats, pairs: Floats) -> Separate:
        """See `Belief`."""
        return Separate(ahead, pairs[:, 0], self.rejections)

    def updated(
        self, model: Model, pixel: Floats, variance: Floats, inputs: Inputs = NO_TIME
    ) -> tuple[Separate, Update]:
        """See `Belief`; with `inputs` the filter's own prediction over that interval comes before the update."""
        state = np.concatenate([self.mean.T, self.blocks[:, UPPER[0], UPPER[1]].T])
        before = Landmarks(state, self.rejections, self.mean[:, :2], np.zeros(len(self.mean)))
        after, update = separate.step(model, before, inputs, pixel, variance)
        return Separate(update.mean, update.covariance, after.rejections), update


@dataclass(frozen=True, slots=True)
class Together:
    """The joint filter: P [3n, 3n] is full."""

    joint: Joint

    @classmethod
    def none(cls) -> Together:
        """No landmark."""
        return cls(Joint.of([]))

    @property
    def mean(self) -> Floats:
        """See `Belief`."""
        return self.joint.mean

    @property
    def blocks(self) -> Floats:
        """See `Belief`."""
        return self.joint.blocks

    def only(self, kept: Longs) -> Together:
        """See `Belief`."""
        return Together(self.joint.only(kept))

    def and_also(self, starts: Sequence[Start]) -> Together:
        """See `Belief`."""
        grown = self.joint
        for start in starts:
            grown = grown.and_also(start)
        return Together(grown)

    @property
    def pairs(self) -> Floats:
        """See `Belief`."""
        n = len(self.joint)
        return self.joint.covariance.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)

    def carried(self, ahead: Floats, pairs: Floats) -> Together:
        """See `Belief`."""
        n = len(ahead)
        return Together(Joint(ahead, pairs.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n), self.joint.rejections))

    def updated(self, model: Model, pixel: Floats, variance: Floats) -> tuple[Together, Update]:
        """See `Belief`; S, K, NIS and likelihood are those of each landmark by itself, before any update."""
        prior = self.joint.blocks
        after, done = joint.step(model, self.joint, NO_TIME, pixel, variance)
        measured = np.isfinite(done.nis)
        spread = np.full((len(prior), 2, 2), np.nan)
        spread[measured] = prior[measured, :2, :2] + variance[measured, None, None] * np.eye(2)
        gain = np.full((len(prior), 3, 2), np.nan)
        gain[measured] = prior[measured, :, :2] @ np.linalg.inv(spread[measured])
        likelihood = -0.5 * (done.nis + np.log(spread[:, 0, 0] * spread[:, 1, 1] - spread[:, 0, 1] ** 2)) - eq.LOG_2PI
        mean, blocks = after.mean, after.blocks
        sigma = np.sqrt(blocks[:, 2, 2])
        near, far = eq.range_interval(mean[:, 2], sigma)
        none = np.full(len(mean), np.nan)
        update = Update(
            prior=done.prior,
            prior_covariance=prior,
            transition=done.transition,
            noise_gain=done.noise_gain,
            innovation=done.innovation,
            innovation_covariance=spread,
            gain=gain,
            nis=done.nis,
            log_likelihood=likelihood,
            outcome=done.outcome,
            mean=mean,
            covariance=blocks,
            rejections=after.rejections,
            inputs=np.zeros(3),
            input_variance=np.zeros(2),
            range_m=1.0 / mean[:, 2],
            range_interval_m=np.stack([near, far], axis=-1),
            relative_sigma=sigma / mean[:, 2],
            parallax_px=none,
            derotated_parallax_px=none,
            focus_distance_px=none,
        )
        return Together(after), update
