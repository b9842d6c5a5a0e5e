"""How failures of the stream of images show: frames that are no frames, and their order in time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from pipelines.verdict import Severity, Verdict
from workbench.diagnosis.finding import Bools, Evidence, Floats
from workbench.diagnosis.path_mode import Bounds, Mode, Shown, Told, evidence, frames
from workbench.diagnosis.path_signals import Signals, usual

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


def _ones(signals: Signals, before: Bools) -> Floats:
    return np.where(signals.compared, 0.0, 1.0)


def _tell_count(what: str) -> Callable[[Shown], Told]:
    def tell(shown: Shown) -> Told:
        signals = shown.signals
        count = int((shown.shows & ~signals.compared).sum())
        since_s = float(np.nanmax(np.where(shown.shows, signals.dt_s, np.nan), initial=0.0))
        sentence = f"{frames(count)} {what}; the motion of up to {since_s:.3f} s has to be found in one step."
        evidence = Evidence(name="dt_s", value=since_s, unit="s", usual=float(np.nanmedian(signals.dt_s)))
        return sentence, (evidence,)

    return tell


def _told_by_alarm(
    name: str, severity: Severity, what: str, cause: str, remedy: str, shows: Callable[[Signals, Bounds, Bools], Bools]
) -> Mode:
    """A failure that an alarm of the odometry names; `what` says of the frames what they are."""
    return Mode(
        name=name,
        severity=severity,
        cause=cause,
        remedy=remedy,
        thresholds={},
        shows=shows,
        strength=_ones,
        tell=_tell_count(what),
    )


DUPLICATE = _told_by_alarm(
    "duplicate-frames",
    Severity.WARNING,
    what="repeat the one before, pixel by pixel",
    cause="the driver or the recorder sends an image again when no new one has come",
    remedy="look at the camera's driver and at its rate; the repeats themselves are passed over and do no harm, "
    "the gap behind them does: raise search_radius_px, or key_max_shift_px",
    shows=_with_next(Verdict.DUPLICATE_FRAME),
)
UNDECODABLE = _told_by_alarm(
    "undecodable-frames",
    Severity.WARNING,
    what="could not be decoded",
    cause="damaged or cut off images in the recording",
    remedy="look at `workbench inspect`: a full disk, a lossy link or an unknown encoding; the frames are passed over",
    shows=_with_next(Verdict.UNDECODABLE),
)
SIZE = _told_by_alarm(
    "size-change",
    Severity.ERROR,
    what="have another size than the one before, and the odometry started again",
    cause="the camera's mode was changed, or two cameras write into one stream",
    remedy="replay the parts by themselves with --from and --to; settings in px are those of one size",
    shows=_ringing(Verdict.SIZE_CHANGED),
)
OUT_OF_ORDER = _told_by_alarm(
    "out-of-order",
    Severity.ERROR,
    what="carry a stamp that is not after the one before, and were left out",
    cause="stamps that stand still or go back: a clock that was set, or a driver that stamps twice",
    remedy="look at `workbench inspect`; stamp the images in the camera's driver by a monotonic clock",
    shows=_with_next(Verdict.OUT_OF_ORDER),
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


def _tell_swapped(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    size = np.hypot(*signals.shift.T)
    return (
        f"Over {shown.frames} the vehicle seems to leap ahead and back in turns: by up to "
        f"{size[worst]:.1f} px against the usual {usual(size)[worst]:.1f} px.",
        (evidence(signals, "frame_shift_px", size, worst, "px"),),
    )


SWAPPED = Mode(
    name="swapped-stamps",
    severity=Severity.WARNING,
    cause="neighbouring images carry each other's stamps, so that they come in the wrong order",
    remedy="replay by the time of the log instead of the stamps, or mend the stamps in the driver",
    thresholds={"back_share": -0.4, "leap_share": 1.4, "min_px": 1.0},
    shows=_swapped,
    strength=lambda signals, _: np.hypot(*signals.shift.T),
    tell=_tell_swapped,
)


def _late(signals: Signals, bounds: Bounds, before: Bools) -> Bools:
    """A gap in the stamps over which the vehicle moved no further than in one usual interval."""
    usual_s, size = usual(signals.dt_s), np.hypot(*signals.shift.T)
    gap = signals.dt_s > bounds["gap_factor"] * usual_s
    moving = usual(size) > bounds["min_px"]
    return np.asarray(gap & moving & (size < bounds["shift_factor"] * usual(size)))


def _tell_late(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    dt_s, size = signals.dt_s, np.hypot(*signals.shift.T)
    return (
        f"The stamps jump by {dt_s[worst]:.3f} s, {dt_s[worst] / usual(dt_s)[worst]:.1f} times the usual, but the "
        f"ground moved by {size[worst]:.1f} px, as in one interval: no image is missing, the stamps are late from here "
        "on.",
        (evidence(signals, "dt_s", dt_s, worst, "s"), evidence(signals, "frame_shift_px", size, worst, "px")),
    )


STAMP_JUMP = Mode(
    name="stamp-jump",
    severity=Severity.WARNING,
    cause="the images' stamps fall behind by a step: a delay in the driver, or a clock that was set",
    remedy="stamp the images when they are taken; against a reference, set its time offset for what comes after",
    thresholds={"gap_factor": 1.6, "shift_factor": 1.4, "min_px": 1.0},
    shows=_late,
    strength=lambda signals, _: signals.dt_s,
    tell=_tell_late,
)


def _tell_gap(shown: Shown) -> Told:
    signals, worst = shown.signals, shown.worst
    dt_s, size = signals.dt_s, np.hypot(*signals.case["frame_shift_px"].T)
    times = dt_s[worst] / usual(dt_s)[worst]
    return (
        f"Before {shown.frames} images are missing, at worst {round(times) - 1} of them: "
        f"{dt_s[worst]:.3f} s without an image, {times:.1f} times the usual.",
        (
            evidence(signals, "dt_s", dt_s, worst, "s", shown.bounds["gap_factor"] * usual(dt_s)[worst]),
            evidence(signals, "frame_shift_px", size, worst, "px"),
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
    strength=lambda signals, _: signals.dt_s,
    tell=_tell_gap,
)
