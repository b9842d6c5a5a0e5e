"""What the flights say of paper C's claims, and of the bars that they are held to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from workbench.reproduce.flights.flying import Flown, Result
from workbench.reproduce.flights.methods import ACCURATE, BASELINE, FAST
from workbench.reproduce.flights.results import (
    BARS,
    FASTEST,
    FEWER_OUTLIERS,
    PAPER_RATIO,
    Results,
)
from workbench.reproduce.judged import Statement, Upshot

SIMILAR = 2.0
"""Two errors are alike when neither is more than so many times the other."""
HONEST_FRAMES = 30


def statements(results: Results) -> list[Statement]:
    """All that can be said of what was flown."""
    return [*_claims(results), *_bars(results)]


def _claims(results: Results) -> Iterator[Statement]:
    for mode in (FAST, ACCURATE):
        if pairs := results.pairs(mode, BASELINE):
            yield _more_accurate(mode, pairs)
    for mode in (FAST, ACCURATE):
        if pairs := results.pairs(mode, BASELINE):
            yield _fewer_outliers(mode, pairs)
    if pairs := results.pairs(FAST, ACCURATE):
        yield _alike(pairs)
    if pairs := results.pairs(FAST, BASELINE):
        yield _quicker(pairs)


def _bars(results: Results) -> Iterator[Statement]:
    for flight, result in results.results():
        bar = BARS.get((flight.flight, result.method))
        if bar is None:
            continue
        a = result.accuracy
        told = f"ATE {a.ate_share:.4%} of the path"
        holds = a.ate_share <= bar.ate_share and a.losses == 0
        claim = f"{flight.flight}, {result.method}: ATE at most {bar.ate_share:.3%} of the path"
        if math.isfinite(bar.scale_drift):
            holds, told = holds and abs(a.scale_drift) <= bar.scale_drift, f"{told}, scale {a.scale_drift:+.2%}"
            claim += f", scale drift at most {bar.scale_drift:.1%}"
        yield Statement(claim, _judged(holds), told + _lost(result))
    for mode, least in FASTEST.items():
        rates = [flight_rate for flight in results.flights if (flight_rate := _rate(flight, mode)) is not None]
        if rates:
            yield Statement(
                f"{mode}: the tracking makes {least:g} frames/s on an idle core",
                _judged(min(rates) >= least),
                f"{_span(rates, '.0f')} frames/s of CPU time, by the median frame of each flight",
            )
    semidirect = [(f, r) for f, r in results.results() if r.method in (FAST, ACCURATE)]
    if semidirect:
        yield _no_loss(semidirect)
        yield _honest(semidirect)


def _more_accurate(mode: str, pairs: Sequence[tuple[Flown, Result, Result]]) -> Statement:
    told = [
        f"{flight.flight} {ours.accuracy.ate_share:.4%} against {theirs.accuracy.ate_share:.4%}{_lost(theirs)}"
        for flight, ours, theirs in pairs
    ]
    return Statement(
        f"{mode} is more accurate than the baseline on every flight",
        _judged(all(_better(ours, theirs) for _, ours, theirs in pairs)),
        "; ".join(told),
    )


def _better(ours: Result, theirs: Result) -> bool:
    """Less error; whoever covers less than half of the way that the other does is the worse one."""
    a, b = ours.accuracy, theirs.accuracy
    if a.covered < 0.5 * b.covered or not math.isfinite(a.ate_share):
        return False
    return b.covered < 0.5 * a.covered or not a.ate_share >= b.ate_share


def _fewer_outliers(mode: str, pairs: Sequence[tuple[Flown, Result, Result]]) -> Statement:
    told, holds = [], True
    for flight, ours, theirs in pairs:
        a, b = ours.map_errors, theirs.map_errors
        holds = holds and FEWER_OUTLIERS * a.outliers <= b.outliers
        told.append(f"{flight.flight} {a.outliers} of {a.points} against {b.outliers} of {b.points}")
    return Statement(
        f"{mode}: ten times fewer outliers in the map than the baseline on every flight",
        _judged(holds),
        "; ".join(told),
    )


def _alike(pairs: Sequence[tuple[Flown, Result, Result]]) -> Statement:
    ratios = np.array([fast.accuracy.ate_share / accurate.accuracy.ate_share for _, fast, accurate in pairs])
    return Statement(
        "Fast and accurate mode hardly differ in accuracy",
        _judged(bool(np.all((ratios <= SIMILAR) & (ratios >= 1 / SIMILAR)))),
        f"the fast mode's error is {_span(ratios.tolist(), '.1f')} times the accurate one's",
    )


def _quicker(pairs: Sequence[tuple[Flown, Result, Result]]) -> Statement:
    ratios = [theirs.work.median_ms / ours.work.median_ms for _, ours, theirs in pairs]
    return Statement(
        f"The fast mode's tracking makes {PAPER_RATIO:.1f} times the baseline's frames/s",
        _judged(min(ratios) >= PAPER_RATIO),
        f"{_span(ratios, '.1f')} times, CPU time in turns",
    )


def _no_loss(flown: Sequence[tuple[Flown, Result]]) -> Statement:
    lost = [f"{flight.flight} {result.method}{_lost(result)}" for flight, result in flown if result.accuracy.losses]
    return Statement("Neither mode is lost on any flight", _judged(not lost), "; ".join(lost) or "no loss")


def _honest(flown: Sequence[tuple[Flown, Result]]) -> Statement:
    worst = max(flown, key=lambda pair: pair[1].accuracy.longest_unnoticed)
    frames = worst[1].accuracy.longest_unnoticed
    return Statement(
        f"No mode stands by a wrong motion for more than {HONEST_FRAMES} frames",
        _judged(frames <= HONEST_FRAMES),
        f"at most {frames} frames, {worst[1].method} on {worst[0].flight}" if frames else "no wrong motion at all",
    )


def _rate(flight: Flown, method: str) -> float | None:
    result = flight.of(method)
    return None if result is None else result.work.frames_per_s


def _span(values: Sequence[float], form: str) -> str:
    """Least and largest of some values."""
    least, largest = (format(value, form) for value in (min(values), max(values)))
    return least if least == largest else f"{least} to {largest}"


def _lost(result: Result) -> str:
    """What a reader must know of losses, beginning with a space or a comma; empty without."""
    a = result.accuracy
    if not a.accepted:
        return " (never started)"
    if not a.losses and a.maps < 2:
        return ""
    return f" (lost {a.losses} times, {a.lost_frames} frames; {a.maps} maps; {a.covered:.0%} of the path)"


def _judged(holds: bool) -> Upshot:
    return Upshot.REACHED if holds else Upshot.MISSED
