"""Rules for runs of the correlation odometry: from failure modes to findings.

A mode is a function from the signals of a run to the frames at which it shows. One frame has one explanation:
the modes are asked in the order of `MODES`, the more specific cause first, and what one has claimed is not
offered to those behind it. A claim takes in its consequences: the frames that were searched with the template of
a spoiled frame, and those until the estimator has found itself again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pipelines.verdict import Severity, Verdict
from workbench.diagnosis.finding import Bools, Case, Finding, Rule, spans_of
from workbench.diagnosis.path_frames import DROPPED, DUPLICATE, OUT_OF_ORDER, SIZE, STAMP_JUMP, SWAPPED, UNDECODABLE
from workbench.diagnosis.path_images import APERTURE, BLUR, DIRT, EXPOSURE, LOW_TEXTURE, NOISE, REPETITIVE
from workbench.diagnosis.path_mode import Bounds, Mode, Shown, frames
from workbench.diagnosis.path_motion import JUMPED, LOST, SIDESLIP, STANDSTILL, TURNED
from workbench.diagnosis.path_scale import LIFTED, MOUNTING, SCALE, TILTED
from workbench.diagnosis.path_signals import Signals

ESTIMATOR = "correlation"
MODES: tuple[Mode, ...] = (
    UNDECODABLE,
    SIZE,
    OUT_OF_ORDER,
    DUPLICATE,
    STAMP_JUMP,
    DROPPED,
    SWAPPED,
    APERTURE,
    REPETITIVE,
    NOISE,
    DIRT,
    EXPOSURE,
    BLUR,
    LOW_TEXTURE,
    TURNED,
    JUMPED,
    LIFTED,
    LOST,
    TILTED,
    STANDSTILL,
    SCALE,
    MOUNTING,
    SIDESLIP,
)


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
    taken = shows.copy()
    if mode.spoils:
        taken |= (signals.template_row >= 0) & shows[signals.template_row]
    if mode.spreads:
        taken = _with_unsettled(signals, taken)
    return Claim(shows, taken & ~before)


def _with_unsettled(signals: Signals, taken: Bools) -> Bools:
    """The frames [n] with those behind them that were not measured, or only by the global search."""
    unsettled = signals.compared & (~signals.accepted | signals.case.rings(Verdict.REACQUIRED))
    taken = taken.copy()
    for k in np.flatnonzero(unsettled[1:]) + 1:
        taken[k] |= taken[k - 1]
    return taken


def _before(case: Case, name: str) -> Bools:
    """The frames [n] that were claimed before a mode has its turn."""
    before = np.zeros(len(case.frame), dtype=bool)
    for other, claim in case.once(claims).items():
        if other == name:
            break
        before |= claim.taken
    return before


def _find(mode: Mode, case: Case, rule: Rule) -> Iterable[Finding]:
    """The finding of a mode, if it shows anywhere: its frames with the consequences."""
    signals, before = case.once(Signals), _before(case, mode.name)
    claim = _claim(signals, mode, rule.thresholds, before)
    if not claim.shows.any():
        return
    strength = np.nan_to_num(mode.strength(signals, before), nan=-1e300)
    worst = int(np.argmax(np.where(claim.shows, strength, -math.inf)))
    sentence, evidence = mode.tell(Shown(signals, rule.thresholds, claim.shows, worst, before))
    lost = signals.compared & ~signals.accepted & claim.taken
    if lost.any() and mode is not LOST:
        sentence += f" The position was lost in {frames(int(lost.sum()))}."
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
