"""What the numbers say, beside what the paper says: every sentence and verdict is computed from the results."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from workbench.reproduce.correction import READINGS, TRUTHS, Effect
from workbench.reproduce.experiment import BEST, EXACT, PAPER, PRINTED, PRIOR
from workbench.reproduce.judged import Statement, Upshot, worst
from workbench.reproduce.measures import Accuracy

RELATIVE = {"relative_x": ("X", 0.0647), "relative_y": ("Y", 0.0491), "relative_euclid": ("Euclid", 0.0569)}
END = {"end_x": ("X", 0.02), "end_y": ("Y", 0.04)}
"""The paper's figures (3.2) by the name of ours."""
BEST_FACTOR = 10.0
CLEAN = "C0"
CLEAR = 0.9
"""An error below this share of another one is clearly smaller."""

Found = Mapping[str, Sequence[Mapping[str, Accuracy]]]
"""By condition, one mapping from method to accuracy for every seed."""


class Spread(NamedTuple):
    """Median, least and largest of a quantity over the seeds."""

    median: float
    least: float
    most: float

    def __str__(self) -> str:
        if self.least == self.most:
            return f"{self.median:.4f}"
        return f"{self.median:.4f} ({self.least:.4f} … {self.most:.4f})"


def spread(runs: Iterable[Mapping[str, Accuracy]], method: str, quantity: str) -> Spread:
    """How one quantity of one method is spread over the seeds."""
    values = [float(getattr(run[method], quantity)) for run in runs]
    return Spread(float(np.median(values)), min(values), max(values))


def upshot(found: Spread, bar: float) -> Upshot:
    """Whether an error is no larger than the bar."""
    if found.median <= bar:
        return Upshot.REACHED
    return Upshot.IN_SCATTER if found.least <= bar else Upshot.MISSED


def statements(found: Found, effects: Sequence[Effect]) -> list[Statement]:
    """All that can be said of what was computed."""
    made = [relative_rms_of(name, runs) for name, runs in found.items()]
    made += [end_point_of(name, runs) for name, runs in found.items()]
    if CLEAN in found:
        made.append(best_is_better(found[CLEAN]))
    made += [correction_of(name, runs) for name, runs in found.items()]
    made.append(no_failures(found))
    if effects:
        made += [correction_helps(effects), correction_harms(effects)]
    return made


def relative_rms_of(condition: str, runs: Sequence[Mapping[str, Accuracy]]) -> Statement:
    """The paper's three relative errors under one condition."""
    spreads = {name: spread(runs, PAPER, name) for name in RELATIVE}
    upshots = {name: upshot(spreads[name], bar) for name, (_, bar) in RELATIVE.items()}
    numbers = "; ".join(f"{label} {spreads[name]}, paper {bar}" for name, (label, bar) in RELATIVE.items())
    overall = worst(upshots.values())
    if overall is not Upshot.REACHED:
        above = [label for name, (label, _) in RELATIVE.items() if upshots[name] is not Upshot.REACHED]
        numbers += f". {' and '.join(above)} above the paper's: {cause(runs)}"
    return Statement(f"{condition}: paper-a's relative rms errors are no worse than the paper's", overall, numbers)


def cause(runs: Sequence[Mapping[str, Accuracy]]) -> str:
    """Why the path is off, told by integrating the same measurements exactly and by their block ratio."""
    as_paper, exact = (spread(runs, method, "relative_euclid").median for method in (PAPER, EXACT))
    told = f"integrated as vectors the same measurements give {exact:.4f} in place of {as_paper:.4f} (Euclid)"
    if exact < CLEAR * as_paper:
        return f"(14), (16), (17) lose the lateral part of the motion; {told}"
    worst_run = max(runs, key=lambda run: run[PAPER].relative_euclid)[PAPER]
    if worst_run.failed_turn_rad > worst_run.heading_rad / 2:
        return (
            f"in the worst drive false peaks ({worst_run.failures}) turn the heading by "
            f"{math.degrees(worst_run.failed_turn_rad):.1f}°, and nothing in the paper's method rejects them; {told}"
        )
    ratio = spread(runs, PAPER, "block_ratio").median
    return (
        f"the heading: its errors over 50 frames are {ratio:.1f} times what independent errors would add up to, which "
        f"is the bias of the single least-squares step; {told}"
    )


def end_point_of(condition: str, runs: Sequence[Mapping[str, Accuracy]]) -> Statement:
    """The paper's end-point errors under one condition, for the method of paper A that comes nearest to them."""
    methods = (PAPER, PRIOR, PRINTED)
    judged = {m: {name: spread(runs, m, name) for name in END} for m in methods}
    excess = {m: max(judged[m][name].median / bar for name, (_, bar) in END.items()) for m in methods}
    nearest = min(methods, key=lambda m: excess[m])
    overall = worst(upshot(judged[nearest][name], bar) for name, (_, bar) in END.items())
    texts = [f"{m}: " + ", ".join(f"{label} {judged[m][name]}" for name, (label, _) in END.items()) for m in methods]
    return Statement(
        f"{condition}: the end point of paper-a, corrected or not, is off by less than 0.02 (X) and 0.04 (Y)",
        overall,
        f"nearest is {nearest}. {'; '.join(texts)}",
    )


def best_is_better(runs: Sequence[Mapping[str, Accuracy]]) -> Statement:
    """How many times better `best` is on the clean sequence."""
    factors = {
        label: sorted(getattr(run[PAPER], name) / getattr(run[BEST], name) for run in runs)
        for label, name in (("relative rms (Euclid)", "relative_euclid"), ("end point", "end_m"))
    }
    judged = factors["relative rms (Euclid)"]
    shares = Spread(float(1 / np.median(judged)), 1 / judged[-1], 1 / judged[0])
    numbers = "; ".join(f"{label}: {np.median(f):.0f} times" + _range(f) for label, f in factors.items())
    return Statement(
        f"{CLEAN}: best is at least {BEST_FACTOR:.0f} times better than paper-a on the clean sequence",
        upshot(shares, 1 / BEST_FACTOR),
        numbers,
    )


def _range(values: Sequence[float]) -> str:
    return "" if len(values) < 2 else f" ({values[0]:.0f} … {values[-1]:.0f} over the seeds)"


def correction_of(condition: str, runs: Sequence[Mapping[str, Accuracy]]) -> Statement:
    """Whether the error drops substantially by the correction, as the paper says of its Fig. 6."""
    without = spread(runs, PAPER, "rms_m")
    readings = {label: spread(runs, method, "rms_m") for label, method in _READINGS.items()}
    nearest = min(readings.values())
    numbers = f"rms error {100 * without.median:.1f} cm without"
    numbers += "".join(f", {100 * s.median:.1f} cm {label}" for label, s in readings.items())
    found = upshot(nearest, CLEAR * without.median)
    if found is not Upshot.REACHED:
        numbers += (
            ". It pulls the path of every 25 frames to that at the nominal speed, which the vehicle does not keep"
        )
    return Statement(f"{condition}: the correction lowers the error", found, numbers)


_READINGS = {"with the speed prior": PRIOR, "as printed": PRINTED}


def no_failures(found: Found) -> Statement:
    """Failures of both presets over everything."""
    counts = {m: sum(run[m].failures for runs in found.values() for run in runs) for m in (PAPER, BEST)}
    motions = sum(run[PAPER].frames - 1 for runs in found.values() for run in runs)
    return Statement(
        "no motion between frames fails (more than 1 px off)",
        Upshot.MISSED if any(counts.values()) else Upshot.REACHED,
        ", ".join(f"{m}: {n} of {motions}" for m, n in counts.items()),
    )


TOWARD = "toward nominal"


def correction_helps(effects: Sequence[Effect]) -> Statement:
    """Without images, a correction toward the nominal speed helps where that is the speed and the scale is wrong."""
    names = [t.name for t in TRUTHS if not t.jitter and (t.scale_error or t.height_share)]
    told = {name: helped_and_harmed(effects, name) for name in names}
    return Statement(
        "without images, the correction toward the nominal speed helps where the speed is constant and the scale wrong",
        Upshot.REACHED if all(TOWARD in helped for helped, _ in told.values()) else Upshot.MISSED,
        _all_told(effects, told),
    )


def correction_harms(effects: Sequence[Effect]) -> Statement:
    """Without images, it harms where the scale is right and the speed is not the nominal one."""
    names = [t.name for t in TRUTHS if t.jitter and not t.scale_error and not t.height_share]
    told = {name: helped_and_harmed(effects, name) for name in names}
    return Statement(
        "without images, the same correction harms where the scale is right and the speed varies",
        Upshot.REACHED if all(TOWARD in harmed for _, harmed in told.values()) else Upshot.MISSED,
        _all_told(effects, told),
    )


def _all_told(effects: Sequence[Effect], told: Mapping[str, tuple[Sequence[str], Sequence[str]]]) -> str:
    rms = {(e.truth, e.reading): 100 * e.rms_m for e in effects}
    return "; ".join(
        f"{name} (rms {rms[name, 'none']:.2f} cm without, {rms[name, TOWARD]:.2f} cm {TOWARD}): {_told(*both)}"
        for name, both in told.items()
    )


def helped_and_harmed(effects: Sequence[Effect], truth: str) -> tuple[list[str], list[str]]:
    """The readings that clearly lower the rms error of a truth, and those that clearly raise it."""
    rms = {e.reading: e.rms_m for e in effects if e.truth == truth}
    others = [reading for reading in READINGS if reading != "none"]
    helped = [reading for reading in others if rms[reading] < CLEAR * rms["none"]]
    harmed = [reading for reading in others if rms[reading] > rms["none"] / CLEAR]
    return helped, harmed


def _told(helped: Sequence[str], harmed: Sequence[str]) -> str:
    parts = [f"{word} {' / '.join(names)}" for word, names in (("helps", helped), ("harms", harmed)) if names]
    return ", ".join(parts) or "no difference"
