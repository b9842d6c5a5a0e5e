"""How failures of the motion show: leaps, turns, losses, standstill, sideways travel."""

from __future__ import annotations

import math

import numpy as np

from pipelines.verdict import Severity
from workbench.diagnosis.finding import Bools, Floats
from workbench.diagnosis.path_mode import Bounds, Mode, Shown, Told, evidence
from workbench.diagnosis.path_signals import Signals, lasting, previous, spread_of

# -------------------------------------------------------------------------------- the motion


def _turned(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    beyond = signals.surprise_rad > bounds["limit_factor"] * signals.case["rotation_limit_rad"]
    return np.asarray(beyond & ~previous(before))  # what comes before has to be known


def _tell_turned(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    limit = float(signals.case["rotation_limit_rad"][worst])
    return (
        f"Between two frames the vehicle turns by {math.degrees(signals.turn[worst]):.1f}°, beyond the "
        f"{math.degrees(limit):.1f}° that a fragment of {int(signals.case['fragment_side_px'][worst])} px stands.",
        (
            evidence(signals, "delta_heading_rad", signals.turn, worst, "rad", limit),
            evidence(signals, "peak_correlation", signals.correlation, worst),
        ),
    )


TURNED = Mode(
    name="rotation-beyond-limit",
    severity=Severity.WARNING,
    cause="a knock, a wheel that slips, or a turn on the spot that is fast for the frame rate",
    remedy="raise the frame rate; rotate_template = true and recovery_rotations_rad with the angle in question; a "
    "smaller fragment_side_px stands more rotation",
    thresholds={"limit_factor": 0.8},
    shows=_turned,
    strength=lambda signals, _: signals.surprise_rad,
    tell=_tell_turned,
)


def _jumped(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    beyond = signals.surprise_px > signals.case["search_radius_px"] + bounds["beyond_px"]
    return np.asarray(beyond & ~previous(before))


def _tell_jumped(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    radius = float(signals.case["search_radius_px"][worst])
    return (
        f"The image content jumps by {signals.surprise_px[worst]:.1f} px more than the speed before lets expect; the "
        f"search reaches {radius:.0f} px.",
        (evidence(signals, "shift against the prediction", signals.surprise_px, worst, "px", radius),),
    )


JUMPED = Mode(
    name="shift-beyond-search",
    severity=Severity.WARNING,
    cause="a knock, slipping wheels, or a speed that changes much between frames",
    remedy="raise search_radius_px, or the frame rate; recovery = true finds the position again by the global search",
    thresholds={"beyond_px": 0.0},
    shows=_jumped,
    strength=lambda signals, _: signals.surprise_px,
    tell=_tell_jumped,
)


def _lost(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    return signals.compared & ~signals.accepted


def _tell_lost(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    return (
        f"In {shown.frames} no motion was found: {int(signals.case['inliers'][worst])} fragments agree, "
        f"the correlation peak is {signals.correlation[worst]:.2f}. The last velocity was held.",
        (
            evidence(signals, "inliers", np.asarray(signals.case["inliers"], dtype=np.float64), worst),
            evidence(signals, "peak_correlation", signals.correlation, worst),
            evidence(signals, "residual_rms", signals.residual, worst, "grey"),
        ),
    )


LOST = Mode(
    name="lost",
    severity=Severity.ERROR,
    cause="nothing in the numbers tells why: something came between camera and ground, or several causes together",
    remedy="look at the image and the correlation surfaces of the worst frame; replay the moment with a larger "
    "search_radius_px or fragment_side_px",
    thresholds={},
    shows=_lost,
    strength=lambda signals, _: -signals.correlation,
    tell=_tell_lost,
)


def _standing(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """Runs of frames whose shift is within its own uncertainty."""
    covariance = signals.case["motion_covariance"]
    sigma_px = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    still = np.hypot(*signals.shift.T) < np.maximum(bounds["sigmas"] * sigma_px, bounds["min_px"])
    still &= ~before
    return lasting(still, int(bounds["min_frames"]))


def _tell_standing(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    path_m = signals.case["path_step_m"]
    return (
        f"Over {shown.frames} the vehicle stands; noise alone adds {1e3 * path_m[shown.shows].sum():.2f} mm to "
        "the length of the path.",
        (evidence(signals, "frame_shift_px", np.hypot(*signals.shift.T), worst, "px", shown.bounds["min_px"]),),
    )


STANDSTILL = Mode(
    name="standstill",
    severity=Severity.NOTICE,
    cause="the vehicle stands",
    remedy="none is needed with integration = exact, where noise cancels; integration = paper turns it into way",
    thresholds={"sigmas": 3.0, "min_px": 0.05, "min_frames": 10},
    shows=_standing,
    strength=lambda signals, _: np.asarray(signals.case["path_step_m"], dtype=np.float64),
    tell=_tell_standing,
    spreads=False,
)


def _travel(signals: Signals, before: Bools) -> Floats:
    """Direction of travel in the body [n], rad, forth and back alike; NaN where it hardly moves.

    The camera moves against the content, u is forward and v right, so that the left part is +v.
    """
    shift = np.where(before[:, None], np.nan, signals.shift)
    shift = np.where(np.hypot(*shift.T)[:, None] > 1.0, shift, np.nan)
    return _undirected(np.arctan2(shift[:, 1], -shift[:, 0]) + float(signals.case.settings["mounting_yaw_rad"]))


def _undirected(angle_rad: Floats) -> Floats:
    """Angles of lines, within ±90°."""
    return np.asarray((angle_rad + np.pi / 2) % np.pi - np.pi / 2)


def _slipping(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    travel = _travel(signals, before)
    known = np.isfinite(travel)
    if signals.case.settings["mount"] == "gimballed" or known.sum() < bounds["min_frames"]:
        return np.zeros(len(travel), dtype=bool)
    middle, spread = spread_of(travel[known])
    return known & (abs(middle) > max(bounds["min_rad"], bounds["spreads"] * spread))


def _tell_slipping(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    travel = _travel(signals, shown.before)
    angle = math.degrees(float(np.nanmedian(travel)))
    return (
        f"The vehicle travels {abs(angle):.1f}° to the {'left' if angle > 0 else 'right'} of its own axis all along.",
        (evidence(signals, "direction of travel", travel, worst, "rad", shown.bounds["min_rad"]),),
    )


SIDESLIP = Mode(
    name="side-slip",
    severity=Severity.NOTICE,
    cause="the vehicle drifts sideways, the camera sits far from the turning point, or it is mounted with a yaw that "
    "mounting_yaw_rad does not know: without a reference they look alike",
    remedy="integration = exact keeps the sideways part, integration = paper loses it; replay with a reference and "
    "--calibrate to tell a mounting yaw from drift",
    thresholds={"min_rad": 0.05, "spreads": 2.0, "min_frames": 20},
    shows=_slipping,
    strength=lambda signals, before: np.abs(_travel(signals, before)),
    tell=_tell_slipping,
    spreads=False,
)
