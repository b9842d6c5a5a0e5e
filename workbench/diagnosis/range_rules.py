"""Rules for runs of the range estimator: one for each way in which ranges fail (paper B's filter).

A rule looks for its own traces in the numbers of the whole run (`range_evidence.py`) and claims frames. Frames that a
more specific cause explains are taken from it (`CAUSES`), so that a frame has one explanation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.filter import Outcome, Status
from pipelines.verdict import Severity, Verdict
from workbench.diagnosis import range_evidence as looks
from workbench.diagnosis.finding import Case, Evidence, Finding, Rule, spans_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Bounds = Mapping[str, float]

DEG = math.degrees(1.0)
MARGIN = 2
"""Frames beside those of a cause whose oddities it explains too."""
EXPLAINED = 0.15
"""Share of a stretch of frames that a cause must cover to take all of it."""
JUMP_REACH = 5
"""Frames beyond half a window in which a jump of the stamps is looked for."""
MEDIAN_CHI2 = 1.386
"""Median of χ² with two degrees of freedom."""
SHOWN = 6
"""Landmarks that a sentence names at most."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """What a rule says of some frames.

    Attributes:
        rows: which [n].
        worst: the row to look at.
        sentence: what happened.
        evidence: the numbers that show it.
        whole: it was found of the run as a whole, so that causes take all of it or nothing.
    """

    rows: Bools
    worst: int
    sentence: str
    evidence: tuple[Evidence, ...]
    whole: bool = False


Claims = Iterator[Claim]
Detect = Callable[[Case, Bounds], Claims]


# ------------------------------------------------------------------------------ small parts


def _grown(rows: Bools, frames: int) -> Bools:
    """The rows and those up to so many beside them."""
    return np.convolve(rows, np.ones(2 * frames + 1), "same") > 0.5


def _runs(rows: Bools, fewest: int) -> Bools:
    """Those rows that lie in runs of so many."""
    kept = np.zeros(len(rows), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(np.int8), [0]])))
    for first, stop in edges.reshape(-1, 2).tolist():
        kept[first:stop] = stop - first >= fewest
    return kept


def _median(values: NDArray[np.floating]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _names(numbers: Iterable[float]) -> str:
    """Numbers of landmarks in words."""
    told = sorted({int(n) for n in numbers})
    some = ", ".join(map(str, told[:SHOWN]))
    word = "landmark" if len(told) == 1 else "landmarks"
    return f"{word} {some}" + (f" and {len(told) - SHOWN} more" if len(told) > SHOWN else "")


def _seconds(case: Case, rows: Bools) -> float:
    """How long so many frames last, s."""
    return float(rows.sum()) * looks.drive(case).usual_dt


def _all(case: Case) -> Bools:
    return np.ones(len(case.frame), bool)


# --------------------------------------------------------------------------- the messages


def _gaps(case: Case, bounds: Bounds) -> Bools:
    """Frames after an interval beyond the usual one."""
    run = looks.drive(case)
    return np.asarray(run.dt > bounds["gap_factor"] * run.usual_dt)


def _inputs_that_came(case: Case) -> Floats:
    """Messages of the inputs since the frame before over the usual number for that time [n]."""
    run = looks.drive(case)
    a_second = case["intervals"] / np.where(run.dt > 0.0, run.dt, np.nan)
    return np.asarray(a_second / _median(a_second))


def _dropped_motion(case: Case, bounds: Bounds) -> Claims:
    share = _inputs_that_came(case)
    rows = _gaps(case, bounds) & (share < bounds["fewest_share"])
    if rows.any():
        run = looks.drive(case)
        worst = int(np.argmax(np.where(rows, run.dt, 0.0)))
        yield Claim(
            rows=rows,
            worst=worst,
            sentence=f"no image and hardly a speed or rate of turn came for {run.dt[worst]:.2f} s: the last ones were "
            f"held over {int(case['intervals'][worst])} intervals, where usually "
            f"{case['intervals'][worst] / share[worst]:.0f} tell the motion",
            evidence=(
                Evidence(name="dt_s", value=run.dt[worst], unit="s", usual=run.usual_dt,
                         bound=bounds["gap_factor"] * run.usual_dt),
                Evidence(name="inputs that came, share of the usual", value=share[worst], usual=1.0,
                         bound=bounds["fewest_share"]),
            ),
        )  # fmt: skip


def _dropped_frames(case: Case, bounds: Bounds) -> Claims:
    rows = _gaps(case, bounds)
    if rows.any():
        run = looks.drive(case)
        worst = int(np.argmax(np.where(rows, run.dt, 0.0)))
        missing = round(float((run.dt[rows] / run.usual_dt - 1.0).sum()))
        yield Claim(
            rows=rows,
            worst=worst,
            sentence=f"about {missing} frames are missing, the longest gap is {run.dt[worst]:.2f} s; the landmarks "
            "were carried on by speed and rate of turn",
            evidence=(
                Evidence(name="dt_s", value=run.dt[worst], unit="s", usual=run.usual_dt,
                         bound=bounds["gap_factor"] * run.usual_dt),
            ),
        )  # fmt: skip


def _missing_inputs(case: Case, bounds: Bounds) -> Claims:
    run = looks.drive(case)
    ages = {"gyro_age_s": case["gyro_age_s"], "odometer_age_s": case["odometer_age_s"]}
    limit = {k: bounds["age_intervals"] * run.usual_dt + _median(v) for k, v in ages.items()}
    old = {k: np.asarray(ages[k] > limit[k]) for k in ages}
    missing = case.rings(Verdict.INPUT_MISSING)
    oldest = np.nan_to_num(np.fmax(*ages.values()))
    rows = old["gyro_age_s"] | old["odometer_age_s"] | missing
    if not rows.any():
        return
    words = {"gyro_age_s": "rate of turn", "odometer_age_s": "speed"}
    which = [words[k] for k in ages if old[k].any()]
    worst = int(np.argmax(np.where(rows, oldest, -1.0)))
    last = int(case.frame[missing][-1]) if missing.any() else -1
    first = f"up to frame {last} there is no speed or no rate of turn: no landmark can start" if last >= 0 else ""
    longest = max((float(np.nanmax(ages[k])) for k in ages if old[k].any()), default=0.0)
    held = f"no {' and no '.join(which)} came for up to {longest:.2f} s; the last one was held" if which else ""
    yield Claim(
        rows=rows,
        worst=worst,
        sentence="; ".join(filter(None, (first, held))),
        evidence=tuple(
            Evidence(name=name, value=float(age[worst]), unit="s", usual=_median(age), bound=limit[name])
            for name, age in ages.items()
        ),
    )


def _swapped_stamps(case: Case, bounds: Bounds) -> Claims:
    """Steps that go back and then too far, by turns; or stamps that do not rise."""
    found = looks.steps(case)
    telling = found.ratio_sigma < bounds["ratio_sigma"]
    back = telling & (found.ratio < bounds["back"])
    far = telling & (found.ratio > bounds["far"])
    turns = np.zeros(len(back), bool)
    turns[1:] |= back[1:] & far[:-1]
    turns[:-1] |= back[:-1] & far[1:]
    many = np.convolve(turns, np.ones(5), "same") >= bounds["in_five"]
    rows = turns & _grown(many, 2)
    backwards = case.rings(Verdict.OUT_OF_ORDER)
    rows = rows | backwards
    if not rows.any():
        return
    worst = int(np.argmin(np.where(rows, np.nan_to_num(found.ratio, nan=1.0), 9.0)))
    words = (
        f"from frame to frame the image goes back and then too far by turns in {int(turns[rows].sum())} frames: its "
        f"step is {found.ratio[worst]:+.1f} times the one that the vehicle made"
    )
    skipped = f"{int(backwards.sum())} frames have a stamp that is not after the one before and were passed over"
    yield Claim(
        rows=rows | (_grown(rows, 2) & telling & (back | far)),
        worst=worst,
        sentence="; ".join(filter(None, (words if turns[rows].any() else "", skipped if backwards.any() else ""))),
        evidence=(
            Evidence(name="step on the image over the predicted one", value=float(found.ratio[worst]),
                     usual=_median(found.ratio[telling]), bound=bounds["back"]),
            Evidence(name="its σ", value=float(found.ratio_sigma[worst])),
            Evidence(name="nis", value=float(looks.median_nis(case)[worst]), usual=_median(looks.median_nis(case)),
                     bound=MEDIAN_CHI2),
        ),
    )  # fmt: skip


def _late_images(case: Case, bounds: Bounds) -> Claims:
    """Turn of the image less the gyro's ≈ - delay · (change of the rate of turn), over a window."""
    found, run = looks.steps(case), looks.drive(case)
    omega = np.nan_to_num(case["omega_radps"])
    change = np.zeros_like(omega)
    change[1:-1] = 0.5 * (omega[2:] - omega[:-2])
    half = max(5, round(0.5 * bounds["window_s"] / run.usual_dt))
    noise = np.hypot(found.turn_sigma_rad, run.settings.sigma_omega * np.sqrt(run.dt))
    delay, sigma = np.full((2, len(omega)), np.nan)
    for k in range(len(omega)):
        near = np.arange(max(0, k - half), min(len(omega), k + half + 1))
        near = near[np.isfinite(found.turn_rad[near])]
        if len(near) < half:
            continue
        turn = found.turn_rad[near]
        kept = near[np.abs(turn - np.median(turn)) <= 4.0 * max(looks.spread(turn), float(np.median(noise[near])))]
        swing = change[kept] - change[kept].mean()  # a bias of the gyro is no delay
        total = float(swing @ swing)
        if total > 0.0:
            delay[k] = -float(found.turn_rad[kept] @ swing) / total
            rest = found.turn_rad[kept] - found.turn_rad[kept].mean() + delay[k] * swing
            scale = max(float(np.sqrt(np.mean(rest**2))), _median(noise[kept]))
            sigma[k] = scale / math.sqrt(total)
    rows = (np.abs(delay) > bounds["sigmas"] * sigma) & (np.abs(delay) > bounds["delay_s"])
    rows = _runs(rows, 3)
    if not rows.any():
        return
    worst = int(np.argmax(np.where(rows, np.abs(delay) / sigma, 0.0)))
    late = float(np.median(delay[rows]))
    rows, jump = _to_jumps(run, rows, late, half)
    jumps = f" (they jump by {1e3 * jump:.0f} ms)" if math.isfinite(jump) else ""
    nis = looks.median_nis(case)
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"the images turn {1e3 * abs(late):.0f} ms {'after' if late > 0 else 'before'} the gyro: their stamps "
        f"are {'late' if late > 0 else 'early'} by that or more{jumps}; while turning at "
        f"{DEG * np.abs(omega[rows]).max():.0f} °/s "
        f"this moves the landmarks by up to {abs(late) * np.abs(omega[rows]).max() * run.camera.focal_px:.0f} px",
        evidence=(
            Evidence(name="delay of the images' stamps", value=float(delay[worst]), unit="s",
                     usual=_median(delay[~rows]), bound=bounds["delay_s"]),
            Evidence(name="its σ", value=float(sigma[worst]), unit="s"),
            Evidence(name="median NIS", value=_median(nis[rows]), usual=_median(nis[~rows]), bound=MEDIAN_CHI2),
        ),
    )  # fmt: skip


def _to_jumps(run: looks.Drive, rows: Bools, late_s: float, reach: int) -> tuple[Bools, float]:
    """The rows, led to where the stamps jump: there an interval is longer by the delay, at the end shorter.

    Also the size of the first such jump, s; NaN where there is none. The window tells less than the whole delay (the
    filter has taken up part of it in its ranges), so that jumps from half of it to thrice as much count.
    """
    out, jump = np.zeros(len(rows), bool), math.nan
    off = (run.dt - run.usual_dt) * math.copysign(1.0, late_s)
    for first, last in spans_of(np.arange(len(rows)), rows, bridge=reach):
        size = abs(late_s)
        begins = np.flatnonzero((off > 0.5 * size) & (off < 3.0 * size))
        begins = begins[np.abs(begins - first) <= reach + JUMP_REACH]
        if len(begins):
            first = int(begins[np.argmin(np.abs(begins - first))])
            jump = float(off[first]) if math.isnan(jump) else jump
        ends = np.flatnonzero((off < -0.1 * size) & (run.dt > 0.0))
        ends = ends[(np.abs(ends - last) <= reach + JUMP_REACH) & (ends > first)]
        last = int(ends[-1]) if len(ends) else last
        out[first : last + 1] = True
    return out, jump


# ------------------------------------------------------------------------------- the tracks


def _track_slip(case: Case, bounds: Bounds) -> Claims:
    """The same landmark is off by the same vector several times in a row, all of a sudden."""
    nis, ids = case["nis"], case["landmark_id"]
    slips: dict[int, list[int]] = {}
    size: dict[int, float] = {}
    blunder = looks.blunders(case, bounds["nis"], bounds["others_nis"])
    for slot in range(ids.shape[1]):
        for found, off_px in _jumps(case, slot, bounds):
            number, length = int(ids[found[0], slot]), float(np.linalg.norm(off_px))
            slips.setdefault(number, []).extend(range(int(found[0]), int(found[-1]) + 1))
            size[number] = max(size.get(number, 0.0), length)
            later = blunder[:, slot] & (ids[:, slot] == number) & (np.arange(len(ids)) > found[-1])
            back = np.linalg.norm(case["innovation_px"][:, slot] + off_px, axis=1) < bounds["back"] * length
            slips[number] += np.flatnonzero(later & back).tolist()
    for number, off in slips.items():
        rows = np.zeros(len(case.frame), bool)
        rows[off] = True
        worst, slot = off[0], int(np.flatnonzero(ids[off[0]] == number)[0])
        again = bool((case["outcome"][rows, slot] == Outcome.RESET).any())
        yield Claim(
            rows=rows,
            worst=worst,
            sentence=f"the track of landmark {number} jumped by {size[number]:.1f} px and stayed there, while the "
            f"other landmarks moved as expected: it follows another point now; its range was "
            f"{'started anew' if again else 'kept'}",
            evidence=(
                Evidence(name=f"nis of landmark {number}", value=float(nis[worst, slot]), usual=_median(nis[:, slot]),
                         bound=bounds["nis"]),
                Evidence(name="median NIS of the frame", value=float(looks.median_nis(case)[worst]),
                         usual=_median(looks.median_nis(case)), bound=bounds["others_nis"]),
                Evidence(name="innovation_px", value=size[number], unit="px",
                         usual=_median(np.linalg.norm(case["innovation_px"][:, slot], axis=1))),
            ),
        )  # fmt: skip


def _jumps(case: Case, slot: int, bounds: Bounds) -> Iterator[tuple[Ints, Floats]]:
    """Rows in which the landmark of a slot is off by one vector, suddenly and alone, and the vector [2], px."""
    off = looks.blunders(case, bounds["nis"], bounds["others_nis"])[:, slot]
    seen = np.flatnonzero(looks.updated(case)[:, slot])
    innovation, outcome = case["innovation_px"][:, slot], case["outcome"][:, slot]
    few, noise_px = int(bounds["in_a_row"]), looks.track_noise(case).shown_px
    for k in range(1, len(seen) - few + 1):
        rows, before = seen[k : k + few], seen[max(0, k - 2) : k]
        if not off[rows].all() or len(set(case["landmark_id"][rows, slot].tolist())) > 1:
            continue
        mean = innovation[rows].mean(axis=0)
        size = float(np.linalg.norm(mean))
        alike = np.abs(innovation[rows] - mean).max() < max(bounds["alike"] * size, bounds["alike_noise"] * noise_px)
        sudden = float(np.linalg.norm(innovation[before[-1]])) < bounds["before"] * size
        # after a reset it may come back from where blunders in a row had led it
        if alike and sudden and not (outcome[before] == Outcome.RESET).any():
            yield rows, mean


def _track_outliers(case: Case, bounds: Bounds) -> Claims:
    off = looks.blunders(case, bounds["nis"], bounds["others_nis"])
    rows = np.asarray(off.any(axis=1))
    if not rows.any():
        return
    size = np.linalg.norm(case["innovation_px"], axis=-1)
    worst = int(np.argmax(np.where(off, case["nis"], 0.0).max(axis=1)))
    used = int((off & (case["outcome"] == Outcome.UPDATED)).sum())
    seen = looks.updated(case)
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"{int(off.sum())} image points of {_names(case['landmark_id'][off])} are blunders, "
        f"{_median(size[off]):.0f} px off while the others of the frame are in place; "
        + (f"{used} of them were used" if used else "the gate kept them out"),
        evidence=(
            Evidence(name="nis", value=float(np.where(off, case["nis"], 0.0)[worst].max()),
                     usual=_median(case["nis"][seen]), bound=bounds["nis"]),
            Evidence(name="share of the points in these frames", value=float(off[rows].sum() / seen[rows].sum())),
            Evidence(name="innovation_px", value=float(size[worst][off[worst]].max()), unit="px",
                     usual=_median(size[seen])),
        ),
    )  # fmt: skip


# ---------------------------------------------------------------------------- the settings


def _overconfident_start(case: Case, bounds: Bounds) -> Claims:
    """The depth that two views tell lies far outside of what the start allowed."""
    run, noise = looks.drive(case), looks.track_noise(case)
    sigma_px = noise.shown_px if noise.points else noise.taken_px
    time = np.cumsum(run.dt)
    ids, outcome = case["landmark_id"], case["outcome"]
    rows = np.zeros(len(case.frame), bool)
    worst, most = 0, 0.0
    wrong: list[tuple[int, float, float, float]] = []
    for first, slot in np.argwhere(outcome == Outcome.STARTED).tolist():
        same = np.flatnonzero((ids[:, slot] == ids[first, slot]) & np.isfinite(run.pixel[:, slot, 0]))
        same = same[(same > first) & (time[same] <= time[first] + bounds["views_s"])]
        if not len(same) or not run.in_plane:
            continue
        told, sigma = looks.depth_at(run, slot, first, int(same[-1]), sigma_px)
        begun, trusted = case["mean"][first, slot, 2], math.sqrt(case["covariance"][first, slot, 2, 2])
        off = abs(told - begun) / math.hypot(trusted, sigma)
        # a view that tells no more than the start did cannot judge it
        if off > bounds["sigmas"] and abs(told - begun) > bounds["share"] * max(told, begun) and told > 0.0:
            wrong.append((int(ids[first, slot]), 1.0 / begun, trusted / begun, 1.0 / told))
            rows |= (time >= time[first]) & (time <= time[first] + bounds["judged_s"])
            rows[first : _last_reset(case, first, slot) + 1] = True
            if off > most:
                worst, most = int(same[0]), off
    if len(wrong) < bounds["fewest"]:
        return
    nis = looks.median_nis(case)
    number, begun, trusted, told = wrong[0]
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"{_names(w[0] for w in wrong)} started at ranges that were trusted too much: landmark {number} at "
        f"{begun:.1f} m ± {100 * trusted:.0f} %, where two views say {told:.1f} m",
        evidence=(
            Evidence(name="start off in σ", value=most, bound=bounds["sigmas"]),
            Evidence(name="median NIS", value=_median(nis[rows]), usual=_median(nis[~rows]), bound=MEDIAN_CHI2),
        ),
    )


def _last_reset(case: Case, first: int, slot: int) -> int:
    """The row of the last reset of the landmark that started in a row; that row where it had none."""
    same = case["landmark_id"][:, slot] == case["landmark_id"][first, slot]
    found = np.flatnonzero(same & (case["outcome"][:, slot] == Outcome.RESET))
    return int(found[-1]) if len(found) else first


def _noise_claim(case: Case, sentence: str, bound: float) -> Claim:
    noise, nis = looks.track_noise(case), looks.median_nis(case)
    rows = np.isfinite(nis)
    return Claim(
        rows=rows,
        whole=True,
        worst=int(np.argmin(np.abs(np.where(rows, nis, np.inf) - _median(nis)))),
        sentence=sentence,
        evidence=(
            Evidence(name="noise that the tracks show", value=noise.shown_px, unit="px", bound=bound * noise.taken_px),
            Evidence(name="noise that the settings say", value=noise.taken_px, unit="px"),
            Evidence(name="median NIS", value=_median(nis), bound=MEDIAN_CHI2),
        ),
    )


def _measurement_noise_too_small(case: Case, bounds: Bounds) -> Claims:
    noise = looks.track_noise(case)
    if noise.points >= bounds["fewest"] and noise.shown_px > bounds["ratio"] * noise.taken_px:
        yield _noise_claim(
            case,
            f"the image points scatter by {noise.shown_px:.2f} px, the filter takes {noise.taken_px:.2f} px: it trusts "
            f"them {noise.shown_px / noise.taken_px:.1f} times too much, and the gate throws good ones away",
            bounds["ratio"],
        )


def _measurement_noise_too_large(case: Case, bounds: Bounds) -> Claims:
    noise = looks.track_noise(case)
    if noise.points >= bounds["fewest"] and noise.shown_px < bounds["ratio"] * noise.taken_px:
        yield _noise_claim(
            case,
            f"the image points scatter by {noise.shown_px:.2f} px only, the filter takes {noise.taken_px:.2f} px: "
            "ranges come later and are told less certain than they are",
            bounds["ratio"],
        )


def _input_noise_too_small(case: Case, bounds: Bounds) -> Claims:
    """All landmarks jump to one side together, to and fro, by more than the gyro's noise."""
    found, run = looks.steps(case), looks.drive(case)
    gyro = run.settings.sigma_omega * np.sqrt(run.dt)
    # changes from step to step: a bias is no noise; they hold three image points, one of them twice
    off = np.full(len(run.dt), np.nan)
    off[1:] = np.diff(found.turn_rad) / np.sqrt(3.0 * found.turn_sigma_rad[1:] ** 2 + gyro[1:] ** 2 + gyro[:-1] ** 2)
    half = max(10, round(0.5 * bounds["window_s"] / run.usual_dt))
    ratio = np.full(len(off), np.nan)
    for k in range(len(off)):
        some = off[max(0, k - half) : k + half + 1]
        if np.isfinite(some).sum() >= half:
            ratio[k] = looks.spread(some)
    rows = _runs(ratio > bounds["ratio"], half)
    if not rows.any():
        return
    shown = looks.spread(found.turn_rad[rows] / np.sqrt(np.where(run.dt[rows] > 0.0, run.dt[rows], np.nan)))
    worst = int(np.argmax(np.where(rows, np.abs(np.nan_to_num(off)), 0.0)))
    nis = looks.median_nis(case)
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"from frame to frame all landmarks jump aside together as by a rate of turn that is noisy by "
        f"{shown:.2g} rad/s/√Hz, the filter takes {run.settings.sigma_omega:.2g}: its uncertainties are too small",
        evidence=(
            Evidence(name="change of the image's turn less the gyro's, in σ", value=float(off[worst]),
                     usual=looks.spread(off),
                     bound=bounds["ratio"]),
            Evidence(name="gyro's noise that the image shows", value=shown, unit="rad/s/√Hz",
                     usual=run.settings.sigma_omega),
            Evidence(name="median NIS", value=_median(nis[rows]), usual=MEDIAN_CHI2),
        ),
    )  # fmt: skip


# --------------------------------------------------------------------------- the sensors


def _gyro_bias(case: Case, bounds: Bounds) -> Claims:
    """The image turns steadily against the gyro."""
    run = looks.drive(case)
    found = looks.pairs(case, bounds["pair_s"], 0.5 * bounds["pair_s"])
    if len(found) < 3:
        return
    told = np.array([looks.turn_of(pair, run.settings.sigma_omega) for pair in found])
    rows = np.zeros(len(case.frame), bool)
    worst, most, rates = 0, 0.0, list[float]()
    for a in range(len(found) - 2):
        rate = told[a : a + 3, 0]
        mean, sigma = float(rate.mean()), 0.75 * float(np.sqrt((told[a : a + 3, 1] ** 2).mean()))  # they overlap
        alike = np.abs(rate - mean).max() < max(bounds["alike"] * abs(mean), 3.0 * sigma)
        if alike and abs(mean) > max(bounds["sigmas"] * sigma, bounds["bias_radps"]):
            rows[found[a].first + 1 : found[a + 2].last + 1] = True
            rates.append(mean)
            if abs(mean) / sigma > most:
                worst, most = (found[a].first + found[a + 2].last) // 2, abs(mean) / sigma
    if not rates:
        return
    if rows[found[-1].last]:  # what is left is too short for a pair of its own
        rows[found[-1].last :] = True
    bias = -float(np.median(rates))
    rest = _rest_rate(case)
    nis = looks.median_nis(case)
    evidence = [
        Evidence(name="gyro less image, rate of turn to the right", value=bias, unit="rad/s",
                 usual=-_median(told[:, 0]), bound=bounds["bias_radps"]),
        Evidence(name="its size in σ", value=most, bound=bounds["sigmas"]),
        Evidence(name="median NIS", value=_median(nis[rows]), usual=_median(nis[~rows]), bound=MEDIAN_CHI2),
    ]  # fmt: skip
    words = ""
    if math.isfinite(rest):
        evidence.append(Evidence(name="omega_radps at rest", value=rest, unit="rad/s", usual=0.0))
        words = f"; while the vehicle stands it tells {DEG * rest:+.2f} °/s"
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"the gyro tells {DEG * abs(bias):.2f} °/s more to the {'right' if bias > 0 else 'left'} than "
        f"the image turns, for {_seconds(case, rows):.0f} s{words}; landmarks level with the focus of expansion suffer "
        "most",
        evidence=tuple(evidence),
    )


def _rest_rate(case: Case) -> float:
    """Mean rate of turn at standstill, bias taken out, rad/s; NaN without a stop."""
    still = case["still"] == 1
    return float(np.nanmean(case["omega_radps"][still])) if still.any() else math.nan


def _wrong_mounting(case: Case, bounds: Bounds) -> Claims:
    """Tracks spread from another point than the filter's focus of expansion."""
    run = looks.drive(case)
    found = looks.focus_of(looks.pairs(case, bounds["pair_s"], 0.5 * bounds["pair_s"]), run.settings.sigma_omega)
    if found is None or found.significance < bounds["sigmas"]:
        return
    x, y = found.off_px.tolist()
    size = math.hypot(x, y)
    if size < bounds["off_px"]:
        return
    nis = looks.median_nis(case)
    distance = _median(np.where(looks.updated(case), case["focus_distance_px"], np.nan))
    focal = run.camera.focal_px
    yield Claim(
        rows=_all(case) & (run.dt >= 0.0),
        whole=True,
        worst=int(len(case.frame) - 1),
        sentence=f"the tracks spread from a point {abs(x):.1f} px to the {'right' if x > 0 else 'left'} and "
        f"{abs(y):.1f} px {'below' if y > 0 else 'above'} of where the filter has its focus of expansion: a landmark "
        f"{distance:.0f} px from it is off by about {100 * size / distance:.0f} %, those on the other side by as much "
        "the other way",
        evidence=(
            Evidence(name="focus of expansion off to the right", value=x, unit="px",
                     usual=0.0, bound=bounds["sigmas"] * math.sqrt(found.covariance[0, 0])),
            Evidence(name="focus of expansion off downwards", value=y, unit="px",
                     usual=0.0, bound=bounds["sigmas"] * math.sqrt(found.covariance[1, 1])),
            Evidence(name="the same as an angle", value=DEG * size / focal, unit="°"),
            Evidence(name="median NIS (shows nothing)", value=_median(nis), usual=MEDIAN_CHI2),
        ),
    )  # fmt: skip


def _odometer_scale(case: Case, bounds: Bounds) -> Claims:
    """Against the reference all landmarks are off by the same factor."""
    if case.reference_depth_m is None:
        return
    run = looks.drive(case)
    told = case["status"] == Status.CONVERGED
    error = np.where(told, case["range_m"] / case.reference_depth_m - 1.0, np.nan)
    sure = case["relative_sigma"] < bounds["relative_sigma"]
    error = np.where(sure, error, np.nan)
    ids = case["landmark_id"]
    numbers = np.unique(ids[np.isfinite(error)])
    each = np.array([_median(error[(ids == n)]) for n in numbers])
    if len(each) < bounds["fewest"]:
        return
    scale, alike = float(np.median(each)), looks.spread(each)
    moved = np.abs(np.nan_to_num(case["speed_mps"])) * run.dt
    way_s = float(run.dt[moved > 0.0].sum())
    by_noise = run.settings.sigma_speed * math.sqrt(way_s) / max(float(moved.sum()), 1e-9)
    limit = max(bounds["share"], bounds["sigmas"] * math.hypot(alike / math.sqrt(len(each)), by_noise))
    if abs(scale) <= limit or alike > bounds["alike"] * abs(scale):
        return
    rows = np.asarray(np.isfinite(error).any(axis=1))
    yield Claim(
        rows=rows,
        whole=True,
        worst=int(np.flatnonzero(rows)[-1]),
        sentence=f"against the reference all {len(each)} landmarks are {100 * abs(scale):.1f} % too "
        f"{'far' if scale > 0 else 'near'}, alike to {100 * alike:.1f} %: the odometer tells "
        f"{100 * abs(scale):.1f} % too {'much' if scale > 0 else 'little'}; nothing inside the filter shows it",
        evidence=(
            Evidence(name="range over reference less 1", value=scale, usual=0.0, bound=limit),
            Evidence(name="its spread over landmarks", value=alike, bound=bounds["alike"] * abs(scale)),
            Evidence(name="what the odometer's noise explains", value=by_noise),
        ),
    )


# ---------------------------------------------------------------------------- the geometry


def _standstill(case: Case, bounds: Bounds) -> Claims:
    """The mean speed over a while is nothing but noise."""
    run = looks.drive(case)
    speed = case["speed_mps"]
    half = max(1, round(0.5 * bounds["window_s"] / run.usual_dt))
    way = np.concatenate([[0.0], np.cumsum(np.nan_to_num(speed) * run.dt)])
    time = np.concatenate([[0.0], np.cumsum(run.dt)])
    first = np.maximum(np.arange(len(speed)) - half, 0)
    last = np.minimum(np.arange(len(speed)) + half + 1, len(speed))
    length = np.where(time[last] > time[first], time[last] - time[first], np.nan)
    mean = np.abs(way[last] - way[first]) / length
    limit = np.fmin(bounds["speed_mps"], bounds["sigmas"] * run.settings.sigma_speed / np.sqrt(length) + 1e-3)
    # of a motion in space the record has the speed ahead only: there the filter's own word counts
    rows = _runs((case["still"] == 1) | ((mean < limit) & run.in_plane), half)
    if not rows.any():
        return
    worst = int(np.flatnonzero(rows)[rows.sum() // 2])
    held = int((case["still"][rows] == 1).sum())
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"the vehicle stands for {_seconds(case, rows):.1f} s: no range gets better; in {held} of "
        f"{int(rows.sum())} frames the filter took the speed for 0",
        evidence=(
            Evidence(name="mean speed", value=float(mean[worst]), unit="m/s", usual=_median(mean),
                     bound=float(limit[worst])),
            Evidence(name="relative_sigma", value=_median(case["relative_sigma"][worst]),
                     usual=_median(case["relative_sigma"])),
        ),
    )  # fmt: skip


def _pure_rotation(case: Case, bounds: Bounds) -> Claims:
    """The vehicle turns on the spot, and the landmarks that it sees move by that alone."""
    run = looks.drive(case)
    omega = np.abs(np.nan_to_num(case["omega_radps"]))
    distance = _median(case["range_m"][case["status"] == Status.CONVERGED])
    distance = distance if math.isfinite(distance) else 1.0 / _median(case["mean"][..., 2])
    by_way = np.abs(np.nan_to_num(case["speed_mps"])) / distance  # parallax and turn as angles a second
    turning = run.in_plane & (omega > bounds["turn_radps"]) & (by_way < bounds["way_share"] * omega)
    rows = _runs(turning, int(bounds["fewest"]))
    if not rows.any():
        return
    worst = int(np.argmax(np.where(rows, omega, 0.0)))
    raw, derotated = case["parallax_px"], case["derotated_parallax_px"]
    young = rows[:, None] & (derotated < run.settings.min_parallax_px) & (raw > run.settings.rotation_parallax_px)
    angle = DEG * float((np.nan_to_num(case["omega_radps"]) * run.dt)[rows].sum())
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"the vehicle turns by {abs(angle):.0f}° on the spot, which tells nothing of ranges: "
        f"{_names(case['landmark_id'][young]) if young.any() else 'no landmark'} moved by up to "
        f"{float(np.nanmax(np.where(rows[:, None], raw, np.nan))):.0f} px, without the rotation less than "
        f"{run.settings.min_parallax_px:.0f} px",
        evidence=(
            Evidence(name="omega_radps", value=float(case["omega_radps"][worst]), unit="rad/s", usual=_median(omega)),
            Evidence(name="speed_mps", value=float(case["speed_mps"][worst]), unit="m/s",
                     usual=_median(case["speed_mps"])),
            Evidence(name="parallax_px", value=_median(raw[worst]), unit="px"),
            Evidence(name="derotated_parallax_px", value=_median(np.where(young, derotated, np.nan)[worst]), unit="px",
                     bound=run.settings.min_parallax_px),
        ),
    )  # fmt: skip


def _near_focus(case: Case, bounds: Bounds) -> Claims:
    """A landmark stays near the focus of expansion, and its range unknown, while the vehicle drives on."""
    run = looks.drive(case)
    ids, distance = case["landmark_id"], case["focus_distance_px"]
    speed = np.abs(np.nan_to_num(case["speed_mps"]))
    driving = speed > 0.3 * _median(speed[speed > 0.0])
    concerned: list[float] = []
    rows = np.zeros(len(case.frame), bool)
    values: list[tuple[float, float, float]] = []
    for number in np.unique(ids[np.isfinite(ids)]).tolist():
        mine = (ids == number) & np.isfinite(distance) & driving[:, None]
        at = np.flatnonzero(mine.any(axis=1))
        slot = mine[at].argmax(axis=1)
        late = np.cumsum(run.dt[at]) > bounds["after_s"]
        sigma = case["relative_sigma"][at, slot]
        others = np.array([_median(np.delete(case["relative_sigma"][k], j)) for k, j in zip(at, slot, strict=True)])
        near = distance[at, slot] < bounds["distance_px"]
        stuck = near & late & (sigma > bounds["relative_sigma"]) & (sigma > bounds["others"] * others)
        if stuck.sum() >= bounds["fewest"]:
            concerned.append(number)
            rows[at[stuck]] = True
            gain = np.linalg.norm(case["gain"][at, slot, 2, :], axis=1)
            values.append((float(np.median(distance[at, slot][stuck])), float(sigma[stuck][-1]), _median(gain)))
    if not concerned:
        return
    worst = int(np.flatnonzero(rows)[-1])
    focus_px, sigma_end, gain_usual = values[0]
    parallax = case["derotated_parallax_px"][worst]
    yield Claim(
        rows=rows,
        worst=worst,
        sentence=f"{_names(concerned)} lies {focus_px:.0f} px from the focus of expansion: driving towards it tells "
        f"nothing of its range, whose σ is still {100 * sigma_end:.0f} % of it",
        evidence=(
            Evidence(name="focus_distance_px", value=focus_px, unit="px", usual=_median(distance),
                     bound=bounds["distance_px"]),
            Evidence(name="relative_sigma", value=sigma_end, usual=_median(case["relative_sigma"][worst]),
                     bound=bounds["relative_sigma"]),
            Evidence(name="gain of ξ", value=gain_usual, unit="1/m/px",
                     usual=_median(np.linalg.norm(case["gain"][..., 2, :], axis=-1))),
            Evidence(name="derotated_parallax_px", value=float(np.nanmin(parallax)), unit="px", usual=_median(parallax),
                     bound=run.settings.min_parallax_px),
        ),
    )  # fmt: skip


# ------------------------------------------------------------------------------- the table

DETECTORS: Mapping[str, Detect] = {
    "dropped-motion": _dropped_motion,
    "missing-inputs": _missing_inputs,
    "dropped-frames": _dropped_frames,
    "swapped-stamps": _swapped_stamps,
    "late-images": _late_images,
    "overconfident-start": _overconfident_start,
    "measurement-noise-too-small": _measurement_noise_too_small,
    "measurement-noise-too-large": _measurement_noise_too_large,
    "input-noise-too-small": _input_noise_too_small,
    "gyro-bias": _gyro_bias,
    "wrong-mounting": _wrong_mounting,
    "track-slip": _track_slip,
    "track-outliers": _track_outliers,
    "pure-rotation": _pure_rotation,
    "standstill": _standstill,
    "near-focus": _near_focus,
    "odometer-scale": _odometer_scale,
}

_STAMPS = ("dropped-motion", "missing-inputs", "swapped-stamps", "late-images")
_COMMON = (
    *_STAMPS,
    "input-noise-too-small",
    "overconfident-start",
    "measurement-noise-too-small",
    "gyro-bias",
    "wrong-mounting",
)
CAUSES: Mapping[str, tuple[str, ...]] = {
    "missing-inputs": ("dropped-motion",),
    "dropped-frames": ("dropped-motion", "late-images"),
    "late-images": ("dropped-motion", "missing-inputs", "swapped-stamps"),
    "input-noise-too-small": _STAMPS,
    "gyro-bias": (*_STAMPS, "input-noise-too-small", "pure-rotation"),
    "wrong-mounting": (*_STAMPS, "input-noise-too-small", "gyro-bias"),
    "track-slip": _COMMON,
    "track-outliers": (*_COMMON, "track-slip"),
    "near-focus": ("pure-rotation", "late-images"),
    "standstill": ("pure-rotation",),
    "odometer-scale": _COMMON,
}
"""Which more specific causes take the frames of a rule: what it sees there is their consequence."""


def _claims(case: Case, rule: Rule) -> list[Claim]:
    """The claims of a rule less what other causes explain."""
    return case.once(lambda c: _left(c, rule), (rule.name, *sorted(rule.thresholds.items())))


def _left(case: Case, rule: Rule) -> list[Claim]:
    made = list(DETECTORS[rule.name](case, rule.thresholds))
    if not made:
        return []
    taken = np.zeros(len(case.frame), bool)
    for cause in CAUSES.get(rule.name, ()):
        for claim in _claims(case, _BY_NAME[cause]):
            taken |= _grown(claim.rows, MARGIN)
    return [left for left in (_without(claim, taken) for claim in made) if left is not None]


def _without(claim: Claim, taken: Bools) -> Claim | None:
    """What remains of a claim: its stretches of frames that are not taken, each whole or not at all."""
    if claim.whole:
        return None if (claim.rows & taken).sum() >= EXPLAINED * claim.rows.sum() else claim
    rows = np.zeros(len(taken), bool)
    for first, last in spans_of(np.arange(len(taken)), claim.rows):
        stretch = slice(first, last + 1)
        if taken[stretch].mean() < EXPLAINED:
            rows[stretch] = claim.rows[stretch] & ~taken[stretch]
    if not rows.any():
        return None
    return replace(claim, rows=rows, worst=claim.worst if rows[claim.worst] else int(np.flatnonzero(rows)[0]))


def _find(case: Case, rule: Rule) -> Iterable[Finding]:
    """The findings of a rule."""
    if len(case.frame) < FEWEST_FRAMES:
        return
    for claim in _claims(case, rule):
        yield Finding(
            rule=rule.name,
            severity=rule.severity,
            spans=spans_of(case.frame, claim.rows),
            worst_frame=int(case.frame[claim.worst]),
            sentence=claim.sentence,
            evidence=claim.evidence,
            cause=rule.cause,
            remedy=rule.remedy,
        )


FEWEST_FRAMES = 10
"""Of fewer frames nothing is told."""


def _rule(name: str, severity: Severity, cause: str, remedy: str, **thresholds: float) -> Rule:
    return Rule(
        name=name, estimator="range", severity=severity, cause=cause, remedy=remedy, thresholds=thresholds, find=_find
    )


RULES: tuple[Rule, ...] = (
    _rule(
        "dropped-motion",
        Severity.WARNING,
        "images and inputs were lost together: the log has a hole, or was cut and joined",
        "record without losses (disk, queue sizes of the recorder); across the hole only the last speeds are known: "
        "replay the two parts apart with --from and --to",
        gap_factor=1.6, fewest_share=0.5,
    ),
    _rule(
        "missing-inputs",
        Severity.WARNING,
        "messages of the gyro or the odometer were lost, or begin later than the images",
        "record the stream without losses; gyro = 'odometry' takes the rate of turn from the wheels where the IMU "
        "fails; input_stale_s says from which age on the filter warns",
        age_intervals=1.5,
    ),
    _rule(
        "dropped-frames",
        Severity.NOTICE,
        "images were lost on the way to the log",
        "nothing for the ranges as long as the inputs are whole; keep_unseen_s says how long a landmark is carried on",
        gap_factor=1.6,
    ),
    _rule(
        "swapped-stamps",
        Severity.ERROR,
        "neighbouring images carry each other's stamps, or were logged out of order",
        "stamp the images at the camera's trigger; write them in the order of their exposure; sort the log by sequence "
        "number where it has one",
        ratio_sigma=0.4, back=0.0, far=1.8, in_five=3,
    ),
    _rule(
        "late-images",
        Severity.ERROR,
        "the images' stamps are those of their arrival, or the clocks of camera and gyro differ",
        "stamp at the exposure, or shift the stamps by the delay that the evidence tells before the replay; "
        "replay --calibrate measures it over a whole drive",
        window_s=4.0, sigmas=6.0, delay_s=0.012,
    ),
    _rule(
        "overconfident-start",
        Severity.ERROR,
        "the start's range is wrong, and its σ too small to be corrected soon",
        "start = 'broad' with start_nearest_m, or a larger start_sigma_m (start = 'range'), start_plane_sigma_m "
        "(start = 'plane'), start_offset_sigma_m (start = 'second-landmark')",
        views_s=5.0, sigmas=4.5, share=0.15, judged_s=1.0, fewest=2,
    ),
    _rule(
        "measurement-noise-too-small",
        Severity.ERROR,
        "R is too small for these tracks",
        "raise tracks.sigma_px (corners.sigma_px, board.sigma_px, markers.sigma_px) to the noise that the tracks show",
        ratio=1.5, fewest=100,
    ),
    _rule(
        "measurement-noise-too-large",
        Severity.WARNING,
        "R is too large for these tracks",
        "lower tracks.sigma_px (corners.sigma_px, board.sigma_px, markers.sigma_px) to the noise that the tracks show",
        ratio=0.6, fewest=100,
    ),
    _rule(
        "input-noise-too-small",
        Severity.ERROR,
        "σ_ω is too small for this gyro, or the vehicle turns in ways that it does not measure",
        "raise sigma_omega to the noise that the image shows; motion = 'spatial' where the vehicle pitches and rolls",
        window_s=5.0, ratio=1.8,
    ),
    _rule(
        "gyro-bias",
        Severity.ERROR,
        "the gyro has a bias that was not taken out",
        "rest for gyro_bias_min_s before the drive (gyro_bias = 'standstill'), or set gyro_bias = 'given' and "
        "gyro_bias_radps to what the evidence tells",
        pair_s=2.0, sigmas=4.5, bias_radps=3e-3, alike=0.7,
    ),
    _rule(
        "wrong-mounting",
        Severity.ERROR,
        "the principal point, or the camera's pitch or yaw in the vehicle, is not what the settings say",
        "set camera_pitch_rad and camera_yaw_rad (or camera_quat_xyzw), or centre_px, by the offset in the evidence; "
        "replay --calibrate measures the focus of expansion on a straight drive",
        pair_s=7.0, sigmas=4.0, off_px=2.5,
    ),
    _rule(
        "track-slip",
        Severity.WARNING,
        "the tracker went over to another point: an edge in front of another, a repeated pattern",
        "reset_after = 3 starts the range anew (0 never does); check tracks forwards and backwards in the tracker",
        nis=25.0, others_nis=6.0, in_a_row=3, alike=0.1, alike_noise=5.0, before=0.4, back=0.5,
    ),
    _rule(
        "track-outliers",
        Severity.WARNING,
        "the tracker took wrong points for single frames",
        "gate = 13.8 keeps them out (off lets them in); check tracks forwards and backwards in the tracker",
        nis=36.0, others_nis=6.0,
    ),
    _rule(
        "pure-rotation",
        Severity.NOTICE,
        "turning on the spot moves all landmarks alike, whatever their range",
        "drive a way of a tenth of the ranges after the turn before they count",
        turn_radps=0.03, way_share=0.1, fewest=5,
    ),
    _rule(
        "standstill",
        Severity.NOTICE,
        "a stop",
        "nothing; zero_velocity_update = true keeps the ranges as they are (standstill_s, standstill_limit_mps)",
        window_s=0.6, sigmas=3.0, speed_mps=0.03,
    ),
    _rule(
        "near-focus",
        Severity.NOTICE,
        "a landmark straight ahead does not move on the image while the vehicle comes nearer",
        "drive past it, or with turns; do not use its range before relative_sigma is below max_relative_sigma; "
        "mode = 'joint' helps a little",
        distance_px=10.0, relative_sigma=0.1, others=4.0, after_s=2.5, fewest=10,
    ),
    _rule(
        "odometer-scale",
        Severity.ERROR,
        "the odometer's scale (wheel radius, ticks per metre, slip)",
        "correct the wheel radius or the ticks per metre of the odometer by the share in the evidence",
        share=0.01, sigmas=4.0, alike=0.5, fewest=4, relative_sigma=0.05,
    ),
)  # fmt: skip
_BY_NAME: Mapping[str, Rule] = {rule.name: rule for rule in RULES}
