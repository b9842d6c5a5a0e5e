"""How failures of the images and of the ground show: exposure, blur, noise, dirt, stripes, repetition, no texture."""

from __future__ import annotations

import math

import numpy as np

from pipelines.verdict import Severity, Verdict
from workbench.diagnosis.finding import Bools, Evidence
from workbench.diagnosis.path_mode import Bounds, Mode, Shown, Told, evidence
from workbench.diagnosis.path_signals import Signals, extended, usual

# --------------------------------------------------------------------------------- the image


def _exposed(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    change = np.abs(signals.brightening)
    jumps = np.abs(np.diff(signals.mean_grey, prepend=signals.mean_grey[:1])) > bounds["min_change_grey"]
    return extended(jumps & (change > bounds["min_change_grey"]), change > bounds["min_change_grey"])


def _tell_exposure(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    change, bound = signals.brightening, shown.bounds["min_change_grey"]
    word = "brighter" if change[worst] > 0 else "darker"
    return (
        f"The same ground is {abs(change[worst]):.0f} grey levels {word} than in the frame it was compared with "
        f"(gain {signals.gain[worst]:.2f}).",
        (
            evidence(signals, "brightening", change, worst, "grey", bound),
            evidence(signals, "gain", signals.gain, worst),
            evidence(signals, "mean_grey", signals.mean_grey, worst, "grey"),
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
    strength=lambda signals, _: np.abs(signals.brightening),
    tell=_tell_exposure,
    spreads=False,
)


def _blurred(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    sharpness = signals.sharpness / usual(signals.sharpness)
    longish = signals.anisotropy > bounds["anisotropy_factor"] * usual(signals.anisotropy)
    dull = (sharpness < bounds["sharpness_ratio"]) & (signals.correlation > bounds["min_correlation"])
    return extended(dull & longish, (sharpness < bounds["weak_sharpness_ratio"]) & longish)


def _tell_blur(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    sharp, long = signals.sharpness, signals.anisotropy
    return (
        f"In {shown.frames} the sharpness falls to {100 * sharp[worst] / usual(sharp)[worst]:.0f} % of "
        f"the usual and the correlation peak is {long[worst]:.1f} times as long as wide.",
        (
            evidence(
                signals, "sharpness", sharp, worst, "1/px²", shown.bounds["sharpness_ratio"] * usual(sharp)[worst]
            ),
            evidence(
                signals, "peak_anisotropy", long, worst, "1", shown.bounds["anisotropy_factor"] * usual(long)[worst]
            ),
            evidence(signals, "peak_correlation", signals.correlation, worst),
        ),
    )


BLUR = Mode(
    name="motion-blur",
    severity=Severity.WARNING,
    cause="the shutter is open for a good part of the frame interval: too little light, or too fast",
    remedy="shorten the exposure or add light; a larger fragment_side_px stands more blur",
    thresholds={"sharpness_ratio": 0.65, "weak_sharpness_ratio": 0.8, "anisotropy_factor": 1.8, "min_correlation": 0.6},
    shows=_blurred,
    strength=lambda signals, _: -signals.sharpness,
    tell=_tell_blur,
    spoils=True,
)


def _noisy(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """White noise of σ leaves residuals of σ to √2 σ and adds four times σ² to the squared gradient."""
    residual = signals.residual
    added = signals.gradient_energy - usual(signals.gradient_energy)
    rough = added > bounds["gradient_share"] * residual**2
    high = residual > bounds["residual_factor"] * usual(residual)
    return extended(high & rough, rough & (residual > bounds["weak_residual_factor"] * usual(residual)))


def _tell_noise(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    residual = signals.residual
    return (
        f"In {shown.frames} up to {residual[worst]:.1f} grey levels remain after the match "
        f"(usual: {usual(residual)[worst]:.1f}), and the image is rough as by noise of that size.",
        (
            evidence(
                signals,
                "residual_rms",
                residual,
                worst,
                "grey",
                shown.bounds["residual_factor"] * usual(residual)[worst],
            ),
            evidence(signals, "gradient_energy", signals.gradient_energy, worst, "grey²/px²"),
            evidence(signals, "peak_correlation", signals.correlation, worst),
        ),
    )


NOISE = Mode(
    name="image-noise",
    severity=Severity.WARNING,
    cause="the sensor's gain is high (too little light), or the link or the codec disturbs the images",
    remedy="add light, lower the camera's gain; a larger fragment_side_px averages over more pixels",
    thresholds={"residual_factor": 1.8, "weak_residual_factor": 1.3, "gradient_share": 0.8},
    shows=_noisy,
    strength=lambda signals, _: signals.residual,
    tell=_tell_noise,
    spoils=True,
)


def _dirty(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """The image content stands still and is badly matched while the vehicle moves: the pattern is on the lens."""
    speed = np.hypot(*signals.shift.T)
    moving = usual(np.where(before, np.nan, speed)) > bounds["min_speed_px"]
    still = speed < bounds["still_share"] * usual(np.where(before, np.nan, speed))
    bad = signals.residual > bounds["residual_factor"] * usual(np.where(before, np.nan, signals.residual))
    weak = bad | signals.case.rings(Verdict.REACQUIRED | Verdict.LOST)
    return extended(still & bad & moving & ~before, weak & ~before)


def _tell_dirt(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    residual, speed = signals.residual, np.hypot(*signals.shift.T)
    return (
        f"In {shown.frames} a pattern that does not move with the ground holds the match: shift "
        f"{speed[worst]:.2f} px against the usual {usual(speed)[worst]:.1f} px, with {residual[worst]:.1f} grey levels "
        "left over.",
        (
            evidence(
                signals,
                "residual_rms",
                residual,
                worst,
                "grey",
                shown.bounds["residual_factor"] * usual(residual)[worst],
            ),
            evidence(signals, "frame_shift_px", speed, worst, "px"),
            evidence(signals, "gain", signals.gain, worst),
        ),
    )


DIRT = Mode(
    name="lens-dirt",
    severity=Severity.ERROR,
    cause="dirt, drops or a reflection on the lens or its window: a pattern that stays in its place in the image",
    remedy="clean the lens; keep fragments away from the spot with columns, rows, span_u_px and span_v_px",
    thresholds={"still_share": 0.3, "residual_factor": 1.6, "min_speed_px": 1.0},
    shows=_dirty,
    strength=lambda signals, _: np.where(np.hypot(*signals.shift.T) < 1.0, signals.residual, 0.0),
    tell=_tell_dirt,
    spoils=True,
)


# -------------------------------------------------------------------------------- the ground


def _striped(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    return extended(signals.condition > bounds["condition"], signals.condition > bounds["weak_condition"])


def _tell_stripes(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    return (
        f"In {shown.frames} the ground has texture in one direction only: the gradients across are "
        f"{math.sqrt(signals.condition[worst]):.1f} times those along, so that the shift along the stripes is open.",
        (
            evidence(signals, "condition", signals.condition, worst, "1", shown.bounds["condition"]),
            evidence(signals, "peak_ratio", signals.peak_ratio, worst),
        ),
    )


APERTURE = Mode(
    name="aperture",
    severity=Severity.WARNING,
    cause="stripes, planks, kerbs or a grating: along them one place looks like the next",
    remedy="use fragments that reach beyond the stripes: more columns and rows, wider span_u_px and span_v_px, a "
    "larger fragment_side_px; or a camera that sees more of the ground",
    thresholds={"condition": 9.0, "weak_condition": 6.0},
    shows=_striped,
    strength=lambda signals, _: signals.condition,
    tell=_tell_stripes,
    spoils=True,
)


def _repeating(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    twin = (signals.peak_ratio > bounds["peak_ratio"]) & (signals.correlation > bounds["min_correlation"])
    return extended(twin, signals.peak_ratio > bounds["weak_peak_ratio"])


def _tell_repeating(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    first, second = (np.asarray(signals.case[name])[worst] for name in ("peak_px", "second_peak_px"))
    period = float(np.nanmedian(np.hypot(*(second - first).T)))
    return (
        f"In {shown.frames} the correlation has a second peak {100 * signals.peak_ratio[worst]:.0f} % as "
        f"high as the first, {period:.0f} px away: the ground repeats itself.",
        (
            evidence(signals, "peak_ratio", signals.peak_ratio, worst, "1", shown.bounds["peak_ratio"]),
            evidence(signals, "peak_correlation", signals.correlation, worst),
            Evidence(name="distance of the peaks", value=period, unit="px"),
        ),
    )


REPETITIVE = Mode(
    name="repetitive-texture",
    severity=Severity.WARNING,
    cause="tiles, gratings, weaves: a shift by one period matches as well as the true one",
    remedy="keep search_radius_px below half the period and prediction = constant-velocity, so that only one peak is "
    "in reach; or a fragment_side_px larger than the period",
    thresholds={"peak_ratio": 0.95, "weak_peak_ratio": 0.8, "min_correlation": 0.7},
    shows=_repeating,
    strength=lambda signals, _: signals.peak_ratio,
    tell=_tell_repeating,
    spoils=True,
)


def _pale(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """The match is low though no more is left over than ever: there is nothing to match."""
    residual = signals.residual < bounds["residual_factor"] * usual(signals.residual)
    weak = signals.eigenvalue < bounds["eigenvalue_share"] * usual(signals.eigenvalue)
    low = signals.correlation < bounds["correlation"]
    return extended(low & residual & weak, (signals.correlation < bounds["weak_correlation"]) & residual & weak)


def _tell_pale(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    correlation, eigenvalue = signals.correlation, signals.eigenvalue
    return (
        f"In {shown.frames} the ground has hardly any texture: the correlation peak is "
        f"{correlation[worst]:.2f} (usual: {usual(correlation)[worst]:.2f}) though only {signals.residual[worst]:.1f} "
        "grey levels remain.",
        (
            evidence(signals, "peak_correlation", correlation, worst, "1", shown.bounds["correlation"]),
            evidence(signals, "smallest_eigenvalue", eigenvalue, worst, "grey²/px²"),
            evidence(signals, "residual_rms", signals.residual, worst, "grey"),
        ),
    )


LOW_TEXTURE = Mode(
    name="low-texture",
    severity=Severity.WARNING,
    cause="smooth or evenly coloured ground, or an image out of focus: noise is all there is to match",
    remedy="focus the camera, light the ground from the side; a larger fragment_side_px gathers more texture",
    thresholds={"correlation": 0.6, "weak_correlation": 0.8, "eigenvalue_share": 0.6, "residual_factor": 1.25},
    shows=_pale,
    strength=lambda signals, _: -signals.correlation,
    tell=_tell_pale,
    spoils=True,
)
