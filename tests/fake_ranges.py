"""Steps of a drive towards some landmarks, made with the filter's own equations, for tests of the log."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.filter import Inputs, Landmarks, Status, statuses, step
from pipelines.ranging.settings import FilterSettings
from pipelines.ranging.start import from_broad_prior
from pipelines.ranging.step import RangeStep
from pipelines.verdict import Verdict
from workbench.range_traces import Beside, RangeScene, level

Floats = NDArray[np.float64]

FOCAL, CENTRE, SIZE = 500.0, (319.5, 239.5), (640.0, 480.0)
SPEED = 0.5
PERIOD_NS = 100_000_000
DT_S = PERIOD_NS * 1e-9


def t_of(frame: int) -> int:
    return 1_712_345_678_123_456_789 + frame * PERIOD_NS


def places(count: int) -> Floats:
    """Landmarks in the world [n, 3]: ahead of the start, on a fan."""
    side = np.linspace(-3, 3, count)
    return np.column_stack([9 + np.cos(3 * side), side, 0.6 * np.sin(5 * side) + 0.2])


def scene(count: int) -> RangeScene:
    return RangeScene(FOCAL, CENTRE, SIZE, surveyed=dict(enumerate(places(count))), referenced=True)


def camera_at(frame: int) -> Floats:
    """x, y, heading: straight ahead along x."""
    return np.array([SPEED * frame * DT_S, 0.0, 0.0])


def pixels(frame: int, count: int) -> Floats:
    away = places(count) - [camera_at(frame)[0], 0, 0]
    x, y, z = -away[:, 1], -away[:, 2], away[:, 0]
    return np.column_stack([CENTRE[0] + FOCAL * x / z, CENTRE[1] + FOCAL * y / z])


def beside(frame: int, slots: int, count: int) -> Beside:
    depth = np.full(slots, np.nan)
    depth[:count] = places(count)[:, 0] - camera_at(frame)[0]
    return Beside(level(camera_at(frame)[None])[0], depth)


def steps(number: int, *, slots: int = 6, count: int = 4, seed: int = 1, late: int = 5) -> Iterator[RangeStep]:
    """Steps with `count` landmarks in `slots` slots; the last landmark comes after `late` frames, and has blunders."""
    rng = np.random.default_rng(seed)
    settings = FilterSettings(pixel_sigma=0.5)
    model = settings.model(FOCAL, CENTRE)
    variance = settings.pixel_sigma**2
    carried = Landmarks.of([])
    for frame in range(number):
        z = pixels(frame, count) + rng.normal(0, settings.pixel_sigma, (count, 2))
        if frame % 50 == 30:
            z[-1] += 40
        seen = rng.random(count) > 0.05
        z[~seen] = np.nan
        if frame == 0 or frame == late:
            new = range(count - 1) if frame == 0 else [count - 1]
            z[new] = np.nan_to_num(z[new], nan=100.0)
            carried = carried.and_also(Landmarks.of([from_broad_prior(one, variance, 2.0) for one in z[new]]))
        n = len(carried)
        carried, update = step(model, carried, Inputs(rng.normal(0, 1e-3), SPEED, DT_S), z[:n], variance)
        status = statuses(update)
        alarms = Verdict.FIRST_FRAME if frame == 0 else Verdict.OK

        def slot(values: Floats, n: int = n) -> Floats:
            padded = np.full((slots, *np.shape(values)[1:]), np.nan)
            padded[:n] = values
            return padded

        yield RangeStep(
            frame=frame,
            t_ns=t_of(frame),
            received_ns=t_of(frame) + 5,
            verdict=alarms,
            alarms=alarms,
            omega_radps=float(update.inputs[0]),
            speed_mps=SPEED,
            dt_s=DT_S if frame else math.nan,
            intervals=1,
            still=0,
            gyro_age_s=0.004,
            odometer_age_s=0.02,
            gyro_bias_radps=0.0,
            focus_px=np.array(CENTRE),
            landmarks=n,
            measured=int(np.isfinite(z[:n, 0]).sum()),
            converged=int((status == Status.CONVERGED).sum()),
            landmark_id=slot(np.arange(n, dtype=float)),
            outcome=slot(update.outcome.astype(float)),
            status=slot(status.astype(float)),
            age_frames=slot(np.full(n, float(frame))),
            prior=slot(update.prior),
            prior_covariance=slot(update.prior_covariance),
            transition=slot(update.transition),
            noise_gain=slot(update.noise_gain),
            measured_px=slot(z[:n]),
            innovation_px=slot(update.innovation),
            innovation_covariance=slot(update.innovation_covariance),
            gain=slot(update.gain),
            nis=slot(update.nis),
            log_likelihood=slot(update.log_likelihood),
            rejections=slot(update.rejections.astype(float)),
            mean=slot(update.mean),
            covariance=slot(update.covariance),
            range_m=slot(update.range_m),
            range_interval_m=slot(update.range_interval_m),
            relative_sigma=slot(update.relative_sigma),
            parallax_px=slot(update.parallax_px),
            derotated_parallax_px=slot(update.derotated_parallax_px),
            focus_distance_px=slot(update.focus_distance_px),
        )
