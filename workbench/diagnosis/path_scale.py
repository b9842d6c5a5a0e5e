"""How a wrong scale shows: height and tilt in the images themselves, the rest against a reference."""

from __future__ import annotations

import math

import numpy as np

from pipelines.planar import wrap_angles
from pipelines.verdict import Severity
from workbench.diagnosis.finding import Bools, Evidence, Floats
from workbench.diagnosis.path_mode import Bounds, Mode, Shown, Told, evidence
from workbench.diagnosis.path_signals import Signals, extended, spread_of, usual

SOUND_RESIDUAL = 2.5
"""What is left of a match that tells a scale is at most this many times the usual."""
PAIR_STEP = 0.04
"""A pair of fragments cannot tell a false match from a lift; but a lift takes more than one frame."""

# ------------------------------------------------------------------------- from image to image


def tilt_slope(signals: Signals, before: Bools) -> float:
    """How much the logarithm of the scale changes per px of shift along u, 1/px; 0 where that is no steady effect."""
    shift = signals.case["centre_shift_px"][:, 0]
    used = signals.accepted & ~before & (np.abs(shift) > 3.0)
    if used.sum() < 20:
        return 0.0
    slope, spread = spread_of(np.log(signals.case["scale"][used]) / shift[used])
    return slope if abs(slope) > max(2.0 * spread, 2e-5) else 0.0


def height_against_scale(signals: Signals, before: Bools) -> Floats:
    """Logarithm of the camera's height over what W takes it to be, beside what is usual around [n].

    The size of the ground's content in the image, from template to template, times W is constant while W follows
    the height. Frames that something else explains, or that do not match, count as if nothing changed; a steady tilt
    is taken out.
    """
    matched = signals.residual < SOUND_RESIDUAL * usual(signals.residual)
    case, used, slope = signals.case, signals.agreeing & matched & ~before, tilt_slope(signals, before)
    if case["peak_correlation"].shape[1] == 2:
        used &= np.abs(case["scale"] - 1.0) < PAIR_STEP
    step = np.where(used, np.log(np.where(used, case["scale"], 1.0)), 0.0)
    base = np.where(used & (signals.template_row >= 0), signals.template_row, np.arange(len(step)) - 1)
    size, way = np.zeros(len(step)), np.zeros(len(step))
    for k in range(1, len(step)):
        size[k] = size[base[k]] + step[k]
        way[k] = way[base[k]] + (case["centre_shift_px"][k, 0] if used[k] else 0.0)
    if slope:
        size -= np.polynomial.Polynomial.fit(way, size, 1)(way)
    size += np.log(case["metres_per_px"])
    return np.asarray(usual(size) - size)


def _lifted(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    away = np.abs(height_against_scale(signals, before))
    return extended(away > bounds["change"], away > bounds["weak_change"])


def _tell_lifted(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    change = float(np.expm1(height_against_scale(signals, shown.before)[worst]))
    higher = change > 0
    return (
        f"Over {shown.frames} the camera is up to {abs(100 * change):.1f} % {'higher' if higher else 'lower'}"
        f" than the scale W takes it to be: the path there is too {'short' if higher else 'long'} by as much.",
        (
            Evidence(name="height over that of W", value=1.0 + change, usual=1.0, bound=1.0 + shown.bounds["change"]),
            evidence(signals, "scale", np.asarray(signals.case["scale"], dtype=np.float64), worst),
            evidence(signals, "height_m", np.asarray(signals.case["height_m"], dtype=np.float64), worst, "m"),
        ),
    )


LIFTED = Mode(
    name="height-change",
    severity=Severity.WARNING,
    cause="the vehicle rises or sinks on its suspension, drives over a step, or the ground falls away",
    remedy="give the height as height_stream; without one the way is wrong by the share of the change",
    thresholds={"change": 0.015, "weak_change": 0.008},
    shows=_lifted,
    strength=lambda signals, before: np.abs(height_against_scale(signals, before)),
    tell=_tell_lifted,
    spreads=False,
)


def _tilted(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    width_px = float(np.nanmedian(signals.case["image_size_px"][:, 0]))
    tilted = abs(tilt_slope(signals, before)) * width_px > bounds["scale_over_width"]
    return signals.accepted & ~before & tilted


def _tell_tilted(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    slope, width_px = tilt_slope(signals, shown.before), float(signals.case["image_size_px"][worst, 0])
    focal_px = signals.case.settings.get("focal_px")
    # ground at u is seen larger by 1 + (u / f) tan(tilt), and once more as much along u, of which half counts
    angle = "" if focal_px is None else f", a pitch of about {math.degrees(math.atan(slope * focal_px / 1.5)):.1f}°"
    return (
        f"The ground grows by {100 * slope * width_px:.1f} % on its way across the image{angle}: the camera does not "
        "look straight down.",
        (
            Evidence(
                name="growth across the image",
                value=slope * width_px,
                usual=0.0,
                bound=shown.bounds["scale_over_width"],
            ),
        ),
    )


TILTED = Mode(
    name="tilt",
    severity=Severity.WARNING,
    cause="the camera looks ahead or back instead of straight down, by its mount or by the vehicle's load",
    remedy="mount the camera level, or rectify the images to the ground plane; metres_per_px holds at one height only",
    thresholds={"scale_over_width": 0.02},
    shows=_tilted,
    strength=lambda signals, _: np.abs(np.log(signals.case["scale"])),
    tell=_tell_tilted,
    spreads=False,
)


# ------------------------------------------------------------------------- against a reference

LEAST_M = 0.3
"""Windows are so long that the reference moves by this, or by a quarter of its whole way."""


def windows(signals: Signals, before: Bools) -> tuple[Floats, Floats, Bools]:
    """Displacements over windows, of estimate and reference [n, 2] each in its body's axes, and which count [n].

    Row k is the window that begins with frame k. One that holds a claimed frame, or no way, does not count.
    """
    case = signals.case
    n, known = len(case.frame), np.isfinite(case.reference).all(axis=1)
    nothing = np.full((n, 2), np.nan)
    if known.sum() < 20:
        return nothing, nothing, np.zeros(n, dtype=bool)
    steps_m = np.hypot(*np.diff(case.reference[known, :2], axis=0).T)
    wanted_m = min(LEAST_M, steps_m.sum() / 4)
    length = int(np.clip(np.ceil(wanted_m / max(steps_m.mean(), 1e-9)), 1, n // 2))
    ours, theirs = (_displaced(poses, length) for poses in (case["pose_raw"], case.reference))
    clean = np.concatenate([[0], np.cumsum(before | (signals.compared & ~signals.accepted))])
    counts = np.zeros(n, dtype=bool)
    counts[: n - length] = clean[length + 1 :] == clean[: n - length]
    counts &= np.hypot(*theirs.T) > 0.5 * wanted_m
    return ours, theirs, counts


def _displaced(poses: Floats, length: int) -> Floats:
    """Displacement over the next `length` poses, in the axes of the first one [n, 2]."""
    found = np.full((len(poses), 2), np.nan)
    dx, dy = (poses[length:, :2] - poses[:-length, :2]).T
    cos, sin = np.cos(poses[:-length, 2]), np.sin(poses[:-length, 2])
    found[:-length] = np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx])
    return found


def length_ratio(signals: Signals, before: Bools) -> Floats:
    """Way of the estimate over that of the reference, for the window that begins at each frame [n]."""
    ours, theirs, counts = windows(signals, before)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(counts, np.hypot(*ours.T) / np.hypot(*theirs.T), np.nan)


def yaw_between(signals: Signals, before: Bools) -> Floats:
    """Direction of travel of the reference minus that of the estimate, each in its body, rad [n]."""
    ours, theirs, counts = windows(signals, before)
    angle = np.arctan2(theirs[:, 1], theirs[:, 0]) - np.arctan2(ours[:, 1], ours[:, 0])
    return np.where(counts, wrap_angles(angle), np.nan)


def _steadily(values: Floats, centre: float, bounds: Bounds) -> Bools:
    """Where values [n] are known, if they lie off their centre by more than a bound and than they scatter."""
    known = np.isfinite(values)
    if known.sum() < bounds["min_windows"]:
        return np.zeros(len(values), dtype=bool)
    middle, spread = spread_of(values[known])
    return known & (abs(middle - centre) > max(bounds["off"], bounds["spreads"] * spread))


def _throughout(signals: Signals, before: Bools, shows: Bools) -> Bools:
    """All measured frames that nothing else explains, if a mode shows at all."""
    return signals.accepted & ~before & shows.any()


def _misscaled(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    return _throughout(signals, before, _steadily(length_ratio(signals, before), 1.0, bounds))


def _tell_misscaled(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    ratio = float(np.nanmedian(length_ratio(signals, shown.before)))
    scale = signals.case["metres_per_px"]
    return (
        f"The path is {abs(100 * (ratio - 1)):.1f} % too {'long' if ratio > 1 else 'short'} against the reference, all "
        f"along: W would have to be {scale[worst] / ratio:.6g} m/px in place of {scale[worst]:.6g}.",
        (
            Evidence(name="way over the reference's", value=ratio, usual=1.0, bound=1.0 + shown.bounds["off"]),
            evidence(signals, "metres_per_px", np.asarray(scale, dtype=np.float64), worst, "m/px"),
        ),
    )


SCALE = Mode(
    name="wrong-scale",
    severity=Severity.WARNING,
    cause="a wrong focal length or a wrong camera height: the calibration of another lens, mode or mount",
    remedy="replay with --calibrate, which measures W against the reference; set metres_per_px or focal_px, height_m",
    thresholds={"off": 0.015, "spreads": 2.0, "min_windows": 10},
    shows=_misscaled,
    strength=lambda signals, before: np.abs(length_ratio(signals, before) - 1.0),
    tell=_tell_misscaled,
    spreads=False,
)


def _misaligned(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    if signals.case.settings["mount"] == "gimballed" or signals.case.settings["integration"] == "paper":
        return np.zeros(len(before), dtype=bool)  # there the heading is not the camera's, or the direction is lost
    return _throughout(signals, before, _steadily(yaw_between(signals, before), 0.0, bounds))


def _tell_misaligned(shown: Shown) -> Told:
    signals = shown.signals
    yaw = float(np.nanmedian(yaw_between(signals, shown.before)))
    given = float(signals.case.settings["mounting_yaw_rad"])
    return (
        f"The estimate travels {abs(math.degrees(yaw)):.2f}° to the {'right' if yaw > 0 else 'left'} of the reference, "
        f"each seen from its own heading: mounting_yaw_rad would have to be {given + yaw:.4f} in place of {given:.4f}.",
        (Evidence(name="yaw against the reference", value=yaw, unit="rad", usual=0.0, bound=shown.bounds["off"]),),
    )


MOUNTING = Mode(
    name="mounting-yaw",
    severity=Severity.WARNING,
    cause="the camera is turned about its optical axis against the vehicle (or the reference's heading is)",
    remedy="replay with --calibrate, which measures the mounting yaw against the reference; set mounting_yaw_rad",
    thresholds={"off": 0.02, "spreads": 2.0, "min_windows": 10},
    shows=_misaligned,
    strength=lambda signals, before: np.abs(yaw_between(signals, before)),
    tell=_tell_misaligned,
    spreads=False,
)
