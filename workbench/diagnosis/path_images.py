"""How failures of the images and of the ground show: exposure, blur, noise, dirt, stripes, repetition, no texture."""

from __future__ import annotations

import math

import numpy as np
import scipy.ndimage

from pipelines.verdict import Severity, Verdict
from workbench.diagnosis.finding import Bools, Evidence, Floats
from workbench.diagnosis.path_mode import Bounds, Mode, Shown, Told, evidence
from workbench.diagnosis.path_signals import USUAL_FRAMES, Signals, extended, lasting, previous, usual

# --------------------------------------------------------------------------------- the image


def _exposed(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """The same ground is brighter or darker at once; up to the return, where there is one soon."""
    bound, grey = bounds["min_change_grey"], signals.mean_grey
    change = np.diff(grey, prepend=grey[:1])
    true = signals.residual < bounds["residual_factor"] * usual(signals.residual)
    differs = np.abs(signals.brightening) > bound
    clipped = (grey > bounds["max_grey"]) | (grey < bounds["min_grey"])  # nothing is left to compare
    jumps = (np.abs(change) > bound) & ((differs & true) | clipped)
    found = extended(jumps, differs & true)
    for k in np.flatnonzero(jumps & ~before):
        back = np.flatnonzero(np.sign(change[k]) * (grey[k:] - grey[k] + change[k] / 2) < 0)
        if len(back) and back[0] < USUAL_FRAMES // 2:
            found[k : k + int(back[0])] = True
    return found


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
    thresholds={"min_change_grey": 8.0, "residual_factor": 3.5, "max_grey": 245.0, "min_grey": 10.0},
    shows=_exposed,
    strength=lambda signals, _: np.nan_to_num(np.abs(signals.brightening)),
    tell=_tell_exposure,
)


def _blurred(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """Sharpness and gain of the match fall at once, until the sharpness is back; or the peak is long as well as low."""
    sharpness, ratio = signals.texture, signals.sharpness / usual(signals.sharpness)
    faded = signals.gain < bounds["gain_ratio"] * usual(signals.gain)
    faded &= signals.gain < bounds["contrast"] * signals.correlation  # gain over correlation: contrast over template's
    raw = signals.sharpness  # that of noise and texture together falls slowly where the ground changes
    fell = (sharpness[1:] < bounds["step_ratio"] * sharpness[:-1]) & (raw[1:] < bounds["raw_step_ratio"] * raw[:-1])
    fell = np.concatenate([[False], fell])
    sound = signals.residual < bounds["residual_factor"] * usual(signals.residual)
    sound &= signals.correlation > bounds["sound_correlation"] * usual(signals.correlation)
    smoothed = scipy.ndimage.median_filter(sharpness, 3)
    onset = np.flatnonzero(fell & faded & previous(sound) & ~before)
    found = np.zeros(len(sharpness), dtype=bool)
    for k in onset:
        level = float(np.median(sharpness[max(k - 5, 0) : k]))
        sharp = np.flatnonzero(smoothed[k + 1 :] > bounds["back_ratio"] * level)
        stop = k + 1 + int(sharp[0]) if len(sharp) else len(sharpness)
        found[k : min(stop, k + USUAL_FRAMES // 2)] = True
    longish = signals.anisotropy > bounds["anisotropy_factor"] * usual(signals.anisotropy)
    clear = signals.correlation > bounds["min_correlation"]
    found |= lasting(longish & clear & (ratio < bounds["sharpness_ratio"]), int(bounds["min_frames"]))
    return found | (signals.template_row >= 0) & found[signals.template_row]  # sharp, against a blurred template


def _tell_blur(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    sharp, long = signals.texture, signals.anisotropy
    return (
        f"In {shown.frames} the sharpness falls to {100 * sharp[worst] / usual(sharp)[worst]:.0f} % of "
        f"the usual and the correlation peak is {long[worst]:.1f} times as long as wide.",
        (
            evidence(signals, "gradient_energy", signals.gradient_energy, worst, "grey²/px²"),
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
    thresholds={
        "step_ratio": 0.85,
        "raw_step_ratio": 0.92,
        "gain_ratio": 0.85,
        "back_ratio": 0.85,
        "sharpness_ratio": 0.5,
        "anisotropy_factor": 2.0,
        "min_correlation": 0.7,
        "residual_factor": 1.5,
        "contrast": 0.95,
        "sound_correlation": 0.6,
        "min_frames": 5,
    },
    shows=_blurred,
    strength=lambda signals, _: -signals.texture,
    tell=_tell_blur,
    spoils=True,
)


def _roughness(signals: Signals) -> Floats:
    """Squared gradient beyond the usual [n], grey²/px², at the usual brightness."""
    more = signals.sharpness - usual(signals.sharpness)
    return np.asarray(more * np.maximum(usual(signals.mean_grey), 1.0) ** 2)


def _held(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """The image content stands still though the vehicle usually moves."""
    speed = np.hypot(*signals.shift.T)
    usual_speed = usual(np.where(before, np.nan, speed))
    return np.asarray((speed < bounds["still_share"] * usual_speed) & (usual_speed > bounds["min_speed_px"]))


def _residual_evidence(shown: Shown) -> Evidence:
    """What remains after the match, and how much is too much."""
    residual = shown.signals.residual
    bound = shown.bounds["residual_factor"] * usual(residual)[shown.worst]
    return evidence(shown.signals, "residual_rms", residual, shown.worst, "grey", bound)


def _noisy(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """White noise of σ leaves residuals of σ to √2 σ and adds four times σ² to the squared gradient."""
    residual = signals.residual
    added = _roughness(signals)
    rough = (added > bounds["gradient_share"] * residual**2) & ~_held(signals, bounds, before)
    rough &= added > bounds["added_share"] * usual(signals.gradient_energy)
    high = residual > bounds["residual_factor"] * usual(residual)
    high &= np.abs(signals.case["scale"] - 1.0) < bounds["max_scale_change"]  # another height leaves much over as well
    return extended(high & rough, rough & (residual > bounds["weak_residual_factor"] * usual(residual)))


def _tell_noise(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    residual = signals.residual
    return (
        f"In {shown.frames} up to {residual[worst]:.1f} grey levels remain after the match "
        f"(usual: {usual(residual)[worst]:.1f}), and the image is rough as by noise of that size.",
        (
            _residual_evidence(shown),
            evidence(signals, "gradient_energy", signals.gradient_energy, worst, "grey²/px²"),
            evidence(signals, "peak_correlation", signals.correlation, worst),
        ),
    )


NOISE = Mode(
    name="image-noise",
    severity=Severity.WARNING,
    cause="the sensor's gain is high (too little light), or the link or the codec disturbs the images",
    remedy="add light, lower the camera's gain; a larger fragment_side_px averages over more pixels",
    thresholds={
        "residual_factor": 1.8,
        "weak_residual_factor": 1.3,
        "max_scale_change": 0.01,
        "added_share": 0.15,
        "gradient_share": 1.0,
        "still_share": 0.3,
        "min_speed_px": 1.0,
    },
    shows=_noisy,
    strength=lambda signals, _: signals.residual,
    tell=_tell_noise,
    spoils=True,
)


def _dirty(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """A pattern on the lens: it holds the match though the vehicle moves, or spoils it with new templates as well."""
    residual = signals.residual / usual(np.where(before, np.nan, signals.residual))
    poor = (residual > bounds["residual_factor"]) & (signals.template_row >= 0)
    smooth = _roughness(signals) < bounds["gradient_share"] * signals.residual**2
    rigid = np.abs(signals.case["scale"] - 1.0) < bounds["max_scale_change"]  # as in noise
    matched = rigid & (signals.correlation > bounds["min_correlation"])
    always = (residual > bounds["always_factor"]) & poor[signals.template_row] & smooth & matched
    always &= lasting(always | ~signals.accepted, int(bounds["min_frames"]))  # one alone is a bad template
    held = _held(signals, bounds, before) & (residual > bounds["held_factor"])
    weak = (poor & smooth) | held | signals.case.rings(Verdict.REACQUIRED | Verdict.LOST)
    return extended((held | always) & ~before, weak & ~before)


def _tell_dirt(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    speed = np.hypot(*signals.shift.T)
    return (
        f"In {shown.frames} {signals.residual[worst]:.1f} grey levels remain after the match (usual: "
        f"{usual(signals.residual)[worst]:.1f}), new templates or not, and the shift is {speed[worst]:.2f} px where "
        f"{usual(speed)[worst]:.1f} px are usual: a pattern does not move with the ground.",
        (
            _residual_evidence(shown),
            evidence(signals, "frame_shift_px", speed, worst, "px"),
            evidence(signals, "gain", signals.gain, worst),
        ),
    )


DIRT = Mode(
    name="lens-dirt",
    severity=Severity.ERROR,
    cause="dirt, drops or a reflection on the lens or its window: a pattern that stays in its place in the image",
    remedy="clean the lens; keep fragments away from the spot with columns, rows, span_u_px and span_v_px",
    thresholds={
        "still_share": 0.3,
        "min_speed_px": 1.0,
        "held_factor": 1.3,
        "residual_factor": 1.6,
        "always_factor": 2.5,
        "gradient_share": 0.8,
        "max_scale_change": 0.01,
        "min_correlation": 0.4,
        "min_frames": 2,
    },
    shows=_dirty,
    strength=lambda signals, _: np.where(signals.accepted, signals.residual, 0.0),
    tell=_tell_dirt,
    spoils=True,
)


# -------------------------------------------------------------------------------- the ground


def _striped(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    condition = signals.case["condition"]  # infinite where there is no texture at all, which is another thing
    share = np.mean(np.isfinite(condition) & (condition > bounds["condition"]), axis=1)
    share = np.where(signals.mean_grey < bounds["max_grey"], share, 0.0)  # a bleached image has few gradients as well
    return lasting(extended(share > bounds["share"], share > bounds["weak_share"]), int(bounds["min_frames"]))


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
    thresholds={"max_grey": 225.0, "min_frames": 4, "condition": 9.0, "share": 0.65, "weak_share": 0.2},
    shows=_striped,
    strength=lambda signals, _: signals.condition,
    tell=_tell_stripes,
    spoils=True,
)


def _twins(signals: Signals, bounds: Bounds) -> Floats:
    """Share of the fragments [n] with a second peak that is nearly as high as the first, and apart from it."""
    apart = np.hypot(*np.moveaxis(signals.case["second_peak_px"] - signals.case["peak_px"], -1, 0))
    twin = (signals.case["peak_ratio"] > bounds["peak_ratio"]) & (apart > bounds["min_apart_px"])
    return np.asarray(np.mean(twin, axis=1))


def _repeating(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    twins, clear = _twins(signals, bounds), signals.correlation > bounds["min_correlation"]
    weak = (twins > bounds["weak_share"]) & clear
    strong = (twins > bounds["share"]) & clear
    if signals.case["peak_correlation"].shape[1] == 2:
        strong |= _torn(signals, bounds["pair_ratio"], bounds["pair_correlation"])
        weak |= _torn(signals, bounds["pair_weak_ratio"], 0.0)
    return lasting(extended(strong, weak), int(bounds["min_frames"]))


def _torn(signals: Signals, ratio: float, correlation: float) -> Bools:
    """One of a pair of fragments follows a twin peak away from the other one: of a pair no more can agree."""
    twin = (signals.case["peak_ratio"] > ratio) & (signals.case["peak_correlation"] > correlation)
    return np.asarray(twin.any(axis=1) & signals.case.rings(Verdict.NOT_RIGID))


def _tell_repeating(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    first, second = (np.asarray(signals.case[name])[worst] for name in ("peak_px", "second_peak_px"))
    ratio = signals.case["peak_ratio"][worst]
    k = int(np.nanargmax(ratio))
    period = float(np.hypot(*(second - first)[k]))
    return (
        f"In {shown.frames} the correlation has a second peak {100 * ratio[k]:.0f} % as "
        f"high as the first, {period:.0f} px away: the ground repeats itself.",
        (
            Evidence(
                name=f"peak_ratio[{k}]",
                value=float(ratio[k]),
                usual=float(usual(signals.peak_ratio)[worst]),
                bound=shown.bounds["peak_ratio"],
            ),
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
    thresholds={
        "peak_ratio": 0.9,
        "share": 0.6,
        "weak_share": 0.3,
        "min_apart_px": 4.5,
        "min_frames": 4,
        "min_correlation": 0.7,
        "pair_ratio": 0.95,
        "pair_weak_ratio": 0.75,
        "pair_correlation": 0.85,
    },
    shows=_repeating,
    strength=lambda signals, _: np.nanmax(np.nan_to_num(signals.case["peak_ratio"]), axis=1),
    tell=_tell_repeating,
    spoils=True,
)


def _pale(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """The match is low though no more is left over than ever: there is nothing to match."""
    usually = signals.residual < bounds["residual_factor"] * usual(signals.residual)
    low = signals.correlation < bounds["correlation"]
    return extended(low & usually, (signals.correlation < bounds["weak_correlation"]) & usually)


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
    thresholds={"correlation": 0.6, "weak_correlation": 0.75, "residual_factor": 1.25},
    shows=_pale,
    strength=lambda signals, _: -signals.correlation,
    tell=_tell_pale,
    spoils=True,
)
