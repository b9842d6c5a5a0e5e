"""Rules for runs of the correlation odometry: how each failure mode is recognised, and what to say of it.

A mode is a function from the signals of a run to the frames at which it shows. One frame has one explanation:
the modes are asked in the order of `MODES`, the more specific cause first, and what one has claimed is not
offered to those behind it. A claim takes in its consequences: the frames that were searched with the template of
a claimed frame, and those until the estimator has found itself again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pipelines.verdict import Severity, Verdict
from workbench.diagnosis.finding import Bools, Case, Evidence, Finding, Floats, Rule, spans_of
from workbench.diagnosis.path_signals import Signals, extended, usual

Bounds = Mapping[str, float]
ESTIMATOR = "correlation"


@dataclass(frozen=True, kw_only=True)
class Mode:
    """How one failure mode shows.

    Attributes:
        name: of the rule.
        shows: the frames [n] at which it shows, given the signals, the bounds and the frames claimed before.
        strength: how much it shows at each frame [n]; the worst frame has the most.
        tell: sentence and evidence, given the signals, the bounds, its frames and the row of the worst one.
        spreads: whether frames that depend on a claimed one are claimed with it.
    """

    name: str
    severity: Severity
    cause: str
    remedy: str
    thresholds: Bounds
    shows: Callable[[Signals, Bounds, Bools], Bools]
    strength: Callable[[Signals], Floats]
    tell: Callable[[Signals, Bounds, Bools, int], tuple[str, tuple[Evidence, ...]]]
    spreads: bool = True


# ------------------------------------------------------------------------- from modes to rules


@dataclass(frozen=True)
class Claim:
    """The frames [n] of a mode: those at which it shows, and those with its consequences."""

    shows: Bools
    taken: Bools


def claims(case: Case) -> dict[str, Claim]:
    """Which mode explains which frames, every frame at most once."""
    signals, claimed = case.once(Signals), np.zeros(len(case.frame), dtype=bool)
    found = {}
    for mode in MODES:
        found[mode.name] = claim = _claim(signals, mode, mode.thresholds, claimed)
        claimed = claimed | claim.taken
    return found


def _claim(signals: Signals, mode: Mode, bounds: Bounds, before: Bools) -> Claim:
    """The frames of a mode, without those that were claimed before it."""
    shows = mode.shows(signals, bounds, before) & ~before
    taken = consequences(signals, shows) & ~before if mode.spreads else shows
    return Claim(shows, taken)


def consequences(signals: Signals, shows: Bools) -> Bools:
    """The frames [n] with those that follow from them.

    A frame that was searched with the template of an affected frame, or that comes after an affected one and was
    not measured or only by the global search, is affected too.
    """
    taken = shows.copy()
    unsettled = signals.compared & (~signals.accepted | signals.case.rings(Verdict.REACQUIRED))
    row = signals.template_row
    for k in np.flatnonzero(~shows):
        if k and ((row[k] >= 0 and taken[row[k]] and row[k] < k - 1) or (taken[k - 1] and unsettled[k])):
            taken[k] = True
    return taken


def _find(mode: Mode, case: Case, rule: Rule) -> Iterable[Finding]:
    """The finding of a mode, if it shows anywhere: its frames with the consequences."""
    signals, found = case.once(Signals), case.once(claims)
    before = np.zeros(len(case.frame), dtype=bool)
    for name, claim in found.items():
        if name == mode.name:
            break
        before |= claim.taken
    claim = _claim(signals, mode, rule.thresholds, before)
    if not claim.shows.any():
        return
    strength = np.where(claim.shows, np.nan_to_num(mode.strength(signals), nan=0.0, posinf=math.inf), -math.inf)
    worst = int(np.argmax(strength))
    sentence, evidence = mode.tell(signals, rule.thresholds, claim.shows, worst)
    lost = signals.compared & ~signals.accepted & claim.taken
    if lost.any():
        sentence += f" The position was lost in {_frames(int(lost.sum()))}."
    yield Finding(
        rule=rule.name,
        severity=Severity.ERROR if lost.any() else rule.severity,
        spans=spans_of(case.frame, claim.taken),
        worst_frame=int(case.frame[worst]),
        sentence=sentence,
        evidence=evidence,
        cause=rule.cause,
        remedy=rule.remedy,
    )


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _of(signals: Signals, name: str, values: Floats, row: int, unit: str = "1", bound: float = math.nan) -> Evidence:
    """A signal at the worst frame, beside what is usual there."""
    return Evidence(
        name=name, value=float(values[row]), unit=unit, usual=float(usual(values)[row]), bound=float(bound)
    )


# ---------------------------------------------------------------------- frames that are no frames


def _ringing(flag: Verdict) -> Callable[[Signals, Bounds, Bools], Bools]:
    return lambda signals, _, __: signals.case.rings(flag)


def _with_next(flag: Verdict) -> Callable[[Signals, Bounds, Bools], Bools]:
    """The frames at which an alarm rings, and the gap after them."""

    def shows(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
        rings = signals.case.rings(flag)
        after = np.concatenate([[False], rings[:-1]]) & signals.case.rings(Verdict.FRAME_GAP)
        return np.asarray(rings | after)

    return shows


def _ones(signals: Signals) -> Floats:
    return np.where(signals.compared, 0.0, 1.0)


def _tell_count(what: str) -> Callable[[Signals, Bounds, Bools, int], tuple[str, tuple[Evidence, ...]]]:
    def tell(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
        count = int((shows & ~signals.compared).sum())
        since_s = float(np.nanmax(np.where(shows, signals.dt_s, np.nan), initial=0.0))
        sentence = f"{_frames(count)} {what}; the motion of up to {since_s:.3f} s has to be found in one step."
        evidence = Evidence(name="dt_s", value=since_s, unit="s", usual=float(np.nanmedian(signals.dt_s)))
        return sentence, (evidence,)

    return tell


DUPLICATE = Mode(
    name="duplicate-frames",
    severity=Severity.WARNING,
    cause="the driver or the recorder sends an image again when no new one has come",
    remedy="look at the camera's driver and at its rate; the repeats themselves are passed over and do no harm, "
    "the gap behind them does: raise search_radius_px, or key_max_shift_px",
    thresholds={},
    shows=_with_next(Verdict.DUPLICATE_FRAME),
    strength=_ones,
    tell=_tell_count("repeat the one before, pixel by pixel"),
)
UNDECODABLE = Mode(
    name="undecodable-frames",
    severity=Severity.WARNING,
    cause="damaged or cut off images in the recording",
    remedy="look at `workbench inspect`: a full disk, a lossy link or an unknown encoding; the frames are passed over",
    thresholds={},
    shows=_with_next(Verdict.UNDECODABLE),
    strength=_ones,
    tell=_tell_count("could not be decoded"),
)
SIZE = Mode(
    name="size-change",
    severity=Severity.ERROR,
    cause="the camera's mode was changed, or two cameras write into one stream",
    remedy="replay the parts by themselves with --start and --stop; settings in px are those of one size",
    thresholds={},
    shows=_ringing(Verdict.SIZE_CHANGED),
    strength=_ones,
    tell=_tell_count("have another size than the one before, and the odometry started again"),
)
OUT_OF_ORDER = Mode(
    name="out-of-order",
    severity=Severity.ERROR,
    cause="stamps that stand still or go back: a clock that was set, or a driver that stamps twice",
    remedy="look at `workbench inspect`; stamp the images in the camera's driver by a monotonic clock",
    thresholds={},
    shows=_with_next(Verdict.OUT_OF_ORDER),
    strength=_ones,
    tell=_tell_count("carry a stamp that is not after the one before, and were left out"),
)


# ----------------------------------------------------------------------------------- in time


def _swapped(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """Back by a frame between two leaps: the signature of neighbours in each other's place, +2 -1 +3 -1 … +2."""
    shift = pd.DataFrame(signals.shift)
    mean = shift.rolling(17, center=True, min_periods=3).mean().to_numpy()  # swapping does not change the sum
    size = np.hypot(*mean.T)
    along = (signals.shift * mean).sum(axis=1) / np.maximum(size, 1e-9)
    back = (along < bounds["back_share"] * size) & (size > bounds["min_px"])
    leap = along > bounds["leap_share"] * size
    middle = back[1:-1] & leap[:-2] & leap[2:]
    found = np.zeros(len(along), dtype=bool)
    for offset in (0, 1, 2):
        found[offset : len(found) - 2 + offset] |= middle
    return found


def _tell_swapped(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    size = np.hypot(*signals.shift.T)
    return (
        f"Over {_frames(int(shows.sum()))} the vehicle seems to leap ahead and back in turns: by up to "
        f"{size[worst]:.1f} px against the usual {usual(size)[worst]:.1f} px.",
        (_of(signals, "frame_shift_px", size, worst, "px"),),
    )


SWAPPED = Mode(
    name="swapped-stamps",
    severity=Severity.WARNING,
    cause="neighbouring images carry each other's stamps, so that they come in the wrong order",
    remedy="replay by the time of the log instead of the stamps, or mend the stamps in the driver",
    thresholds={"back_share": -0.4, "leap_share": 1.4, "min_px": 1.0},
    shows=_swapped,
    strength=lambda signals: np.hypot(*signals.shift.T),
    tell=_tell_swapped,
)


def _tell_gap(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    dt_s, size = signals.dt_s, np.hypot(*signals.case["frame_shift_px"].T)
    times = dt_s[worst] / usual(dt_s)[worst]
    return (
        f"Before {_frames(int(shows.sum()))} images are missing, at worst {round(times) - 1} of them: "
        f"{dt_s[worst]:.3f} s without an image, {times:.1f} times the usual.",
        (
            _of(signals, "dt_s", dt_s, worst, "s", bounds["gap_factor"] * usual(dt_s)[worst]),
            _of(signals, "frame_shift_px", size, worst, "px"),
        ),
    )


DROPPED = Mode(
    name="dropped-frames",
    severity=Severity.WARNING,
    cause="images were lost on the way to the log: a full buffer, a slow disk, a link without room",
    remedy="record less or faster; meanwhile prediction = constant-velocity and a larger search_radius_px carry over "
    "short gaps",
    thresholds={"gap_factor": 1.6},
    shows=lambda signals, bounds, _: signals.dt_s > bounds["gap_factor"] * usual(signals.dt_s),
    strength=lambda signals: signals.dt_s,
    tell=_tell_gap,
)


# --------------------------------------------------------------------------------- the image


def _exposed(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    change = np.abs(signals.brightening)
    jumps = np.abs(np.diff(signals.mean_grey, prepend=signals.mean_grey[:1])) > bounds["min_change_grey"]
    return extended(jumps & (change > bounds["min_change_grey"]), change > bounds["min_change_grey"])


def _tell_exposure(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    change, bound = signals.brightening, bounds["min_change_grey"]
    word = "brighter" if change[worst] > 0 else "darker"
    return (
        f"The same ground is {abs(change[worst]):.0f} grey levels {word} than in the frame it was compared with "
        f"(gain {signals.gain[worst]:.2f}).",
        (
            _of(signals, "brightening", change, worst, "grey", bound),
            _of(signals, "gain", signals.gain, worst),
            _of(signals, "mean_grey", signals.mean_grey, worst, "grey"),
        ),
    )


EXPOSURE = Mode(
    name="exposure-jump",
    severity=Severity.WARNING,
    cause="the camera's automatic exposure, a lamp, or a shadow",
    remedy="fix the exposure of the camera; gain_and_offset = true with refiner = inverse-compositional takes it out, "
    "a wider accepted_gain lets stronger jumps through",
    thresholds={"min_change_grey": 8.0},
    shows=_exposed,
    strength=lambda signals: np.abs(signals.brightening),
    tell=_tell_exposure,
    spreads=False,
)


def _blurred(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    sharpness = signals.sharpness / usual(signals.sharpness)
    longish = signals.anisotropy > bounds["anisotropy_factor"] * usual(signals.anisotropy)
    dull = sharpness < bounds["sharpness_ratio"]
    return extended(dull & longish, (sharpness < bounds["weak_sharpness_ratio"]) & longish)


def _tell_blur(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    sharp, long = signals.sharpness, signals.anisotropy
    return (
        f"In {_frames(int(shows.sum()))} the sharpness falls to {100 * sharp[worst] / usual(sharp)[worst]:.0f} % of "
        f"the usual and the correlation peak is {long[worst]:.1f} times as long as wide.",
        (
            _of(signals, "sharpness", sharp, worst, "1/px²", bounds["sharpness_ratio"] * usual(sharp)[worst]),
            _of(signals, "peak_anisotropy", long, worst, "1", bounds["anisotropy_factor"] * usual(long)[worst]),
            _of(signals, "peak_correlation", signals.correlation, worst),
        ),
    )


BLUR = Mode(
    name="motion-blur",
    severity=Severity.WARNING,
    cause="the shutter is open for a good part of the frame interval: too little light, or too fast",
    remedy="shorten the exposure or add light; a larger fragment_side_px stands more blur",
    thresholds={"sharpness_ratio": 0.65, "weak_sharpness_ratio": 0.8, "anisotropy_factor": 1.8},
    shows=_blurred,
    strength=lambda signals: -signals.sharpness,
    tell=_tell_blur,
)


def _noisy(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """White noise of σ leaves residuals of σ to √2 σ and adds four times σ² to the squared gradient."""
    residual = signals.residual
    added = signals.gradient_energy - usual(signals.gradient_energy)
    rough = added > bounds["gradient_share"] * residual**2
    high = residual > bounds["residual_factor"] * usual(residual)
    return extended(high & rough, rough & (residual > bounds["weak_residual_factor"] * usual(residual)))


def _tell_noise(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    residual = signals.residual
    return (
        f"In {_frames(int(shows.sum()))} up to {residual[worst]:.1f} grey levels remain after the match "
        f"(usual: {usual(residual)[worst]:.1f}), and the image is rough as by noise of that size.",
        (
            _of(signals, "residual_rms", residual, worst, "grey", bounds["residual_factor"] * usual(residual)[worst]),
            _of(signals, "gradient_energy", signals.gradient_energy, worst, "grey²/px²"),
            _of(signals, "peak_correlation", signals.correlation, worst),
        ),
    )


NOISE = Mode(
    name="image-noise",
    severity=Severity.WARNING,
    cause="the sensor's gain is high (too little light), or the link or the codec disturbs the images",
    remedy="add light, lower the camera's gain; a larger fragment_side_px averages over more pixels",
    thresholds={"residual_factor": 1.8, "weak_residual_factor": 1.3, "gradient_share": 0.8},
    shows=_noisy,
    strength=lambda signals: signals.residual,
    tell=_tell_noise,
)


def _dirty(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """The image content stands still and is badly matched while the vehicle moves: the pattern is on the lens."""
    speed = np.hypot(*signals.shift.T)
    moving = usual(np.where(before, np.nan, speed)) > bounds["min_speed_px"]
    still = speed < bounds["still_share"] * usual(np.where(before, np.nan, speed))
    bad = signals.residual > bounds["residual_factor"] * usual(np.where(before, np.nan, signals.residual))
    weak = bad | signals.case.rings(Verdict.REACQUIRED | Verdict.LOST)
    return extended(still & bad & moving & ~before, weak & ~before)


def _tell_dirt(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    residual, speed = signals.residual, np.hypot(*signals.shift.T)
    return (
        f"In {_frames(int(shows.sum()))} a pattern that does not move with the ground holds the match: shift "
        f"{speed[worst]:.2f} px against the usual {usual(speed)[worst]:.1f} px, with {residual[worst]:.1f} grey levels "
        "left over.",
        (
            _of(signals, "residual_rms", residual, worst, "grey", bounds["residual_factor"] * usual(residual)[worst]),
            _of(signals, "frame_shift_px", speed, worst, "px"),
            _of(signals, "gain", signals.gain, worst),
        ),
    )


DIRT = Mode(
    name="lens-dirt",
    severity=Severity.ERROR,
    cause="dirt, drops or a reflection on the lens or its window: a pattern that stays in its place in the image",
    remedy="clean the lens; keep fragments away from the spot with columns, rows, span_u_px and span_v_px",
    thresholds={"still_share": 0.3, "residual_factor": 1.6, "min_speed_px": 1.0},
    shows=_dirty,
    strength=lambda signals: np.where(np.hypot(*signals.shift.T) < 1.0, signals.residual, 0.0),
    tell=_tell_dirt,
)


# -------------------------------------------------------------------------------- the ground


def _striped(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    return extended(signals.condition > bounds["condition"], signals.condition > bounds["weak_condition"])


def _tell_stripes(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    return (
        f"In {_frames(int(shows.sum()))} the ground has texture in one direction only: the gradients across are "
        f"{math.sqrt(signals.condition[worst]):.1f} times those along, so that the shift along the stripes is open.",
        (
            _of(signals, "condition", signals.condition, worst, "1", bounds["condition"]),
            _of(signals, "peak_ratio", signals.peak_ratio, worst),
        ),
    )


APERTURE = Mode(
    name="aperture",
    severity=Severity.WARNING,
    cause="stripes, planks, kerbs or a grating: along them one place looks like the next",
    remedy="use fragments that reach beyond the stripes: more columns and rows, wider span_u_px and span_v_px, a larger "
    "fragment_side_px; or a camera that sees more of the ground",
    thresholds={"condition": 9.0, "weak_condition": 6.0},
    shows=_striped,
    strength=lambda signals: signals.condition,
    tell=_tell_stripes,
)


def _repeating(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    twin = (signals.peak_ratio > bounds["peak_ratio"]) & (signals.correlation > bounds["min_correlation"])
    return extended(twin, signals.peak_ratio > bounds["weak_peak_ratio"])


def _tell_repeating(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    first, second = (np.asarray(signals.case[name])[worst] for name in ("peak_px", "second_peak_px"))
    period = float(np.nanmedian(np.hypot(*(second - first).T)))
    return (
        f"In {_frames(int(shows.sum()))} the correlation has a second peak {100 * signals.peak_ratio[worst]:.0f} % as "
        f"high as the first, {period:.0f} px away: the ground repeats itself.",
        (
            _of(signals, "peak_ratio", signals.peak_ratio, worst, "1", bounds["peak_ratio"]),
            _of(signals, "peak_correlation", signals.correlation, worst),
            Evidence(name="distance of the peaks", value=period, unit="px"),
        ),
    )


REPETITIVE = Mode(
    name="repetitive-texture",
    severity=Severity.WARNING,
    cause="tiles, gratings, weaves: a shift by one period matches as well as the true one",
    remedy="keep search_radius_px below half the period and prediction = constant-velocity, so that only one peak is in "
    "reach; or a fragment_side_px larger than the period",
    thresholds={"peak_ratio": 0.95, "weak_peak_ratio": 0.8, "min_correlation": 0.7},
    shows=_repeating,
    strength=lambda signals: signals.peak_ratio,
    tell=_tell_repeating,
)


def _pale(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """The match is low though no more is left over than ever: there is nothing to match."""
    residual = signals.residual < bounds["residual_factor"] * usual(signals.residual)
    weak = signals.eigenvalue < bounds["eigenvalue_share"] * usual(signals.eigenvalue)
    low = signals.correlation < bounds["correlation"]
    return extended(low & residual & weak, (signals.correlation < bounds["weak_correlation"]) & residual & weak)


def _tell_pale(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    correlation, eigenvalue = signals.correlation, signals.eigenvalue
    return (
        f"In {_frames(int(shows.sum()))} the ground has hardly any texture: the correlation peak is "
        f"{correlation[worst]:.2f} (usual: {usual(correlation)[worst]:.2f}) though only {signals.residual[worst]:.1f} "
        "grey levels remain.",
        (
            _of(signals, "peak_correlation", correlation, worst, "1", bounds["correlation"]),
            _of(signals, "smallest_eigenvalue", eigenvalue, worst, "grey²/px²"),
            _of(signals, "residual_rms", signals.residual, worst, "grey"),
        ),
    )


LOW_TEXTURE = Mode(
    name="low-texture",
    severity=Severity.WARNING,
    cause="smooth or evenly coloured ground, or an image out of focus: noise is all there is to match",
    remedy="focus the camera, light the ground from the side; a larger fragment_side_px gathers more texture",
    thresholds={"correlation": 0.6, "weak_correlation": 0.8, "eigenvalue_share": 0.6, "residual_factor": 1.25},
    shows=_pale,
    strength=lambda signals: -signals.correlation,
    tell=_tell_pale,
)


# -------------------------------------------------------------------------------- the motion


def _turned(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    return np.asarray(signals.surprise_rad > bounds["limit_factor"] * signals.case["rotation_limit_rad"])


def _tell_turned(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    limit = float(signals.case["rotation_limit_rad"][worst])
    return (
        f"Between two frames the vehicle turns by {math.degrees(signals.turn[worst]):.1f}°, beyond the "
        f"{math.degrees(limit):.1f}° that a fragment of {int(signals.case['fragment_side_px'][worst])} px stands.",
        (
            _of(signals, "delta_heading_rad", signals.turn, worst, "rad", limit),
            _of(signals, "peak_correlation", signals.correlation, worst),
        ),
    )


TURNED = Mode(
    name="rotation-beyond-limit",
    severity=Severity.WARNING,
    cause="a knock, a wheel that slips, or a turn on the spot that is fast for the frame rate",
    remedy="raise the frame rate; rotate_template = true and recovery_rotations_rad with the angle in question; a smaller "
    "fragment_side_px stands more rotation",
    thresholds={"limit_factor": 0.8},
    shows=_turned,
    strength=lambda signals: signals.surprise_rad,
    tell=_tell_turned,
)


def _jumped(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    return np.asarray(signals.surprise_px > signals.case["search_radius_px"] + bounds["beyond_px"])


def _tell_jumped(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    radius = float(signals.case["search_radius_px"][worst])
    return (
        f"The image content jumps by {signals.surprise_px[worst]:.1f} px more than the speed before lets expect; the "
        f"search reaches {radius:.0f} px.",
        (_of(signals, "shift against the prediction", signals.surprise_px, worst, "px", radius),),
    )


JUMPED = Mode(
    name="shift-beyond-search",
    severity=Severity.WARNING,
    cause="a knock, slipping wheels, or a speed that changes much between frames",
    remedy="raise search_radius_px, or the frame rate; recovery = true finds the position again by the global search",
    thresholds={"beyond_px": 0.0},
    shows=_jumped,
    strength=lambda signals: signals.surprise_px,
    tell=_tell_jumped,
)


# ------------------------------------------------------------------------------------- scale


def _log_scale(signals: Signals, before: Bools) -> Floats:
    """Logarithm of what a metre of ground measures in the image times W, since the first frame [n].

    It is constant while W follows the height. Frames that something else explains count as if nothing changed.
    """
    case = signals.case
    step = np.log(np.where(signals.accepted & ~before, case["scale"], 1.0))
    step -= tilt_slope(signals, before) * np.where(signals.accepted & ~before, case["centre_shift_px"][:, 0], 0.0)
    sizes, row = np.zeros(len(step)), signals.template_row
    for k in range(1, len(step)):
        base = row[k] if row[k] >= 0 and signals.accepted[k] and not before[k] else k - 1
        sizes[k] = sizes[base] + step[k]
    return sizes + np.log(case["metres_per_px"])


def tilt_slope(signals: Signals, before: Bools) -> float:
    """How much the scale changes per px of shift along u, 1/px; 0 where that is no steady effect."""
    shift = signals.case["centre_shift_px"][:, 0]
    used = signals.accepted & ~before & (np.abs(shift) > 3.0)
    if used.sum() < 20:
        return 0.0
    slopes = np.log(signals.case["scale"][used]) / shift[used]
    slope = float(np.median(slopes))
    spread = 1.4826 * float(np.median(np.abs(slopes - slope)))
    return slope if abs(slope) > 3.0 * spread and abs(slope) > 2e-5 else 0.0


def _lifted(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    away = np.abs(_away(signals, before))
    return extended(away > bounds["change"], away > bounds["weak_change"])


def _away(signals: Signals, before: Bools) -> Floats:
    size = _log_scale(signals, before)
    return np.asarray(size - usual(size))


def _nothing(signals: Signals) -> Bools:
    return np.zeros(len(signals.case.frame), dtype=bool)


def _tell_lifted(signals: Signals, bounds: Bounds, shows: Bools, worst: int) -> tuple[str, tuple[Evidence, ...]]:
    change = float(np.expm1(-_away(signals, _before(signals, "height-change"))[worst]))
    return (
        f"Over {_frames(int(shows.sum()))} the camera is {abs(100 * change):.1f} % {'higher' if change > 0 else 'lower'} "
        "than the scale W takes it to be: the path there is too "
        f"{'short' if change > 0 else 'long'} by as much.",
        (
            Evidence(name="height against W", value=1 + change, usual=1.0, bound=bounds["change"]),
            _of(signals, "scale", signals.case["scale"], worst),
            _of(signals, "height_m", signals.case["height_m"], worst, "m"),
        ),
    )


def _before(signals: Signals, name: str) -> Bools:
    """The frames that were claimed before a mode."""
    before = np.zeros(len(signals.case.frame), dtype=bool)
    for other, claim in signals.case.once(claims).items():
        if other == name:
            break
        before |= claim.taken
    return before


LIFTED = Mode(
    name="height-change",
    severity=Severity.WARNING,
    cause="the vehicle rises or sinks on its suspension, drives over a step, or the ground falls away",
    remedy="give the height as height_stream; without one the way is wrong by the share of the change",
    thresholds={"change": 0.015, "weak_change": 0.008},
    shows=_lifted,
    strength=lambda signals: np.abs(_away(signals, _before(signals, "height-change"))),
    tell=_tell_lifted,
    spreads=False,
)


MODES: tuple[Mode, ...] = (
    UNDECODABLE,
    SIZE,
    OUT_OF_ORDER,
    DUPLICATE,
    DROPPED,
    SWAPPED,
    EXPOSURE,
    BLUR,
    NOISE,
    APERTURE,
    REPETITIVE,
    LOW_TEXTURE,
    DIRT,
    TURNED,
    JUMPED,
    LIFTED,
)


def _rules() -> Iterator[Rule]:
    for mode in MODES:
        yield Rule(
            name=mode.name,
            estimator=ESTIMATOR,
            severity=mode.severity,
            cause=mode.cause,
            remedy=mode.remedy,
            thresholds=mode.thresholds,
            find=functools.partial(_find, mode),
        )


RULES: tuple[Rule, ...] = tuple(_rules())
