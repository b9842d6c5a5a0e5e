"""What is said at the end of a run: counts, shares, and plain sentences on whether method and data suit each other."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pipelines.evaluation import Evaluation, Relative, Statistics
from pipelines.verdict import Severity, Verdict, flags, gravest

NOTABLE_SHARE = 0.05
TRUSTED_SHARE = 0.5
MOST_CAUSES = 6
MOST_LANDMARKS = 24
SLOW_FRAMES_S = 0.5
NOTABLE_DRIFT = 0.05
STILL_M = 0.05

ADVICE: Mapping[Verdict, str] = {
    Verdict.DUPLICATE_FRAME: "the log repeats frames; they carry no motion",
    Verdict.FRAME_GAP: "frames are missing in the log, or its stamps are irregular",
    Verdict.HEIGHT_CHANGE: "the camera's height is not constant, or it tilts: "
    "without a height stream the scale is wrong",
    Verdict.EXPOSURE_JUMP: "the brightness changes from frame to frame: fix the exposure, or set gain_and_offset",
    Verdict.BLURRED: "motion blur: a shorter exposure is needed",
    Verdict.PEAK_AMBIGUOUS: "the surface repeats itself: a match one period away looks as good as the right one",
    Verdict.PEAK_AT_BORDER: "the motion between frames is longer than the search: raise search_radius_px",
    Verdict.LOW_CORRELATION: "the frames do not look like their templates: too little overlap, turning too fast, "
    "or no flat ground below the camera",
    Verdict.LOW_TEXTURE: "the surface has too little texture: raise fragment_side_px",
    Verdict.APERTURE: "the texture is striped and does not tell the shift along its stripes",
    Verdict.RESIDUAL_HIGH: "the matches leave much unexplained: relief, shadows, blur or compression",
    Verdict.ROTATION_BEYOND_LIMIT: "it turns faster between frames than fragments of this size allow (1)",
    Verdict.SUBPIXEL_DIVERGED: "the subpixel refinement does not settle: false peaks or too little texture",
    Verdict.SEARCH_OUTSIDE_IMAGE: "the search areas leave the image: the motion is long or the image is small",
    Verdict.NOT_RIGID: "the fragments do not move as one plane: false peaks, relief, moving things, "
    "or a camera that does not look straight down",
    Verdict.TOO_FEW_INLIERS: "too few fragments agree: false peaks, relief, "
    "or a camera that does not look straight down",
    Verdict.OUT_OF_ORDER: "stamps go backwards; those frames were skipped",
    Verdict.SIZE_CHANGED: "the image size changes within the stream",
    Verdict.UNDECODABLE: "images are damaged",
    Verdict.LOST: "the search does not lock; the path there is the last velocity held on, not a measurement",
    Verdict.LANDMARK_REJECTED: "blunders of the tracks, or a point that is not where the filter expects it",
    Verdict.LANDMARK_RESET: "tracks slip from one point to another, or the motion is not that of the inputs",
    Verdict.NO_LANDMARKS: "nothing is tracked there",
    Verdict.PURE_ROTATION: "the robot turns on the spot: drive to get ranges",
    Verdict.NIS_HIGH: "raise the noise of the image points (tracks.sigma_px and the like), sigma_omega or "
    "sigma_speed, and check stamps, calibration and mounting",
    Verdict.NIS_LOW: "lower the noise of the image points (tracks.sigma_px and the like), sigma_omega or sigma_speed",
    Verdict.INNOVATIONS_ONE_SIDED: "the start is wrong: a broad start finds the range by itself",
    Verdict.INNOVATIONS_ALTERNATE: "frames or stamps are swapped",
    Verdict.INNOVATIONS_FOLLOW_TURN: "images come with late or early stamps: shift them",
    Verdict.INPUT_STALE: "the odometry or the IMU has gaps",
    Verdict.INPUT_MISSING: "no odometry or no rate of turn at the start",
    Verdict.INPUT_OUT_OF_ORDER: "stamps of the odometry or the IMU go backwards",
    Verdict.INPUT_UNREADABLE: "messages of the odometry or the IMU are damaged",
    Verdict.SCALE_DRIFT: "the scale drifts, or the ground is not as high as at the start: try the preset accurate",
    Verdict.FEW_POINTS: "the map has too few points in view: fly slower, or lower keyframe_distance or "
    "corner_threshold",
    Verdict.POINTS_DROPPED: "points vanish at once: blur, something before the camera, or a leap between frames",
    Verdict.ALIGNMENT_FAILED: "the camera moves further between two frames than the alignment follows: more frames a "
    "second, or align_coarsest higher",
    Verdict.RELOCALISED: "found again by a keyframe that looked alike; on a surface that repeats itself that can be "
    "another place",
    Verdict.NEW_MAP: "a new map was begun after a loss: mend the cause of the loss",
    Verdict.POINTS_UNLIKE: "the view leaps to where the map's points are not: missing frames, a cut, or something "
    "that covers the view",
}

CIRCUMSTANCES = Verdict.DUPLICATE_FRAME | Verdict.FRAME_GAP | Verdict.HEIGHT_CHANGE | Verdict.EXPOSURE_JUMP
"""Alarms about the recording, not about the match: a motion that was measured under them is measured."""


@dataclass(slots=True)
class Tally:
    """Counts the steps of a run while they pass by.

    `used` steps have a measured motion; of those, `failed` ones broke a check that makes a motion worthless, and
    `doubtful` ones a check that makes it uncertain.
    """

    frames: int = 0
    used: int = 0
    failed: int = 0
    doubtful: int = 0
    verdicts: Counter[Verdict] = field(default_factory=Counter)
    alarms: Counter[Verdict] = field(default_factory=Counter)

    def add(self, verdict: Verdict, alarms: Verdict, accepted: bool) -> None:
        """Take note of one step."""
        self.frames += 1
        self.used += accepted
        if accepted:
            failed, doubtful = _worth(alarms)
            self.failed += failed
            self.doubtful += doubtful
        self.verdicts[verdict] += 1
        for flag in flags(alarms):
            self.alarms[flag] += 1

    def named(self) -> dict[str, int]:
        """Frames by verdict, most frequent first."""
        return {name_of(v): n for v, n in self.verdicts.most_common()}

    def named_alarms(self) -> dict[str, int]:
        """Frames by alarm, most frequent first; a frame can have several."""
        return {name_of(v): n for v, n in self.alarms.most_common()}


def name_of(verdict: Verdict) -> str:
    """The name of one verdict."""
    return verdict.name or "OK"


def suitability(tally: Tally, median_dt_s: float, evaluation: Evaluation | None = None) -> list[str]:
    """Plain sentences on how far the method suits the recording: the upshot first, then the gravest causes."""
    if tally.frames < 2:
        return ["fewer than two frames: there is no motion to estimate"]
    causes = _disagreement(evaluation)
    if median_dt_s > SLOW_FRAMES_S:
        causes.append(
            f"median time between frames {median_dt_s:.3g} s: the method expects frames that overlap by far, "
            "as at video rate; between distant frames its motion prediction has nothing to go by"
        )
    causes += _causes(tally)
    return [_upshot(tally, bool(causes)), *causes[:MOST_CAUSES]]


NIS_APART = 1.3
"""Ratio of the mean NIS to its expectation, or the inverse, from which the filter's noise settings are wrong."""
NEES_APART = 2.0
"""The same of the NEES against the reference, which has errors of its own."""
LEAST_COVERAGE = 0.8


def range_suitability(tally: Tally, ranging: Mapping[str, Any]) -> list[str]:
    """Plain sentences on what the ranges of a run are worth: the upshot first, then the gravest causes."""
    if not ranging["landmarks"]:
        return ["do not trust: no landmark was ever found", *_causes(tally)]
    doubts, causes = _range_doubts(ranging), _causes(tally)
    share = percent(ranging["converged_share"])
    good = (
        f"{ranging['converged_landmarks']} of {ranging['landmarks']} landmarks converged; {share} of the ranges count"
    )
    if doubts:
        return [f"do not trust the uncertainties: {good}", *doubts, *causes][:MOST_CAUSES]
    if not ranging["converged_landmarks"]:
        return [f"no range counts: {good}", *causes][:MOST_CAUSES]
    told = "look at what follows" if causes else "the innovations are what the filter expects"
    return [f"{good}; {told}", *causes][:MOST_CAUSES]


def visual_suitability(tally: Tally, found: Mapping[str, Any], evaluation: Evaluation | None = None) -> list[str]:
    """Plain sentences on what the path of a visual odometry is worth: the upshot first, then the gravest causes."""
    if not found["frames_with_pose"]:
        return ["do not trust: no map was ever started, so that there is no path", *_causes(tally)][: 1 + MOST_CAUSES]
    causes = _disagreement(evaluation)
    if found["losses"]:
        count, frames = len(found["losses"]), found["lost_frames"]
        causes.append(f"lost {_times(count)}, for {frames} frames in all: the last pose is held there, not measured")
    if found["relocalised"]:
        causes.append(
            f"found again {_times(len(found['relocalised']))} (frame {', '.join(map(str, found['relocalised'][:4]))}): "
            "what follows hangs on one keyframe that looked alike"
        )
    if found["maps"] > 1:
        causes.append(f"{found['maps']} maps: each has its own place, heading and scale")
    causes += _causes(tally, leave=Verdict.LOST)
    measured = found["frames_with_pose"] / tally.frames
    good = f"{percent(measured)} of the frames have a pose of their own"
    if measured < TRUSTED_SHARE:
        return [f"do not trust this path: {good}", *causes[:MOST_CAUSES]]
    told = "look at what follows" if causes else "nothing in the images speaks against the method"
    return [f"{good}; {told}", *causes[:MOST_CAUSES]]


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _range_doubts(ranging: Mapping[str, Any]) -> list[str]:
    """What speaks against the filter's own uncertainties: NIS, and NEES where a reference is."""
    doubts = []
    nis = ranging["nis"]
    ratio = nis["mean"] / nis["expected"]
    if ratio > NIS_APART or ratio < 1 / NIS_APART:
        size = "larger" if ratio > 1 else "smaller"
        doubts.append(
            f"mean NIS {nis['mean']:.3g} where {nis['expected']:.0f} is expected: the innovations are {size} than the "
            "filter's noise settings say"
        )
    error = ranging["error"]
    if error is None:
        return doubts
    if error["nees"] > NEES_APART or error["coverage"] < LEAST_COVERAGE:
        doubts.append(
            f"NEES {error['nees']:.3g} of the inverse depth where 1 is expected, {percent(error['coverage'])} within "
            "2σ where 95 % are: the ranges are worse than the filter says"
        )
    elif error["nees"] < 1 / (2 * NEES_APART):
        doubts.append(
            f"NEES {error['nees']:.3g} of the inverse depth where 1 is expected: the ranges are better than the filter "
            "says"
        )
    return doubts


def _causes(tally: Tally, leave: Verdict = Verdict.OK) -> list[str]:
    """The alarms that many frames have and that can be acted on, gravest first; without those told elsewhere."""
    causes = []
    told = (verdict for verdict in ADVICE if verdict not in leave)
    for verdict in sorted(told, key=lambda v: (v.severity, tally.alarms[v]), reverse=True):
        share = tally.alarms[verdict] / tally.frames if tally.frames else 0.0
        if share >= NOTABLE_SHARE:
            causes.append(f"{percent(share)} of the frames {name_of(verdict)}: {ADVICE[verdict]}")
    return causes


def _disagreement(evaluation: Evaluation | None) -> list[str]:
    """What the reference says against the path, which the images alone do not tell."""
    if evaluation is None:
        return []
    if evaluation.reference_path_m < STILL_M:
        moved = f"the reference moves {evaluation.reference_path_m:.2g} m in all"
        return [f"{moved}: it hardly tells anything about the path"]
    if not evaluation.drift > NOTABLE_DRIFT:
        return []
    ratio = evaluation.path_m / evaluation.reference_path_m
    return [
        f"the reference disagrees: the end is off by {percent(evaluation.drift)} of the path, whose length is "
        f"{ratio:.3g} times the reference's"
    ]


def _upshot(tally: Tally, doubts: bool) -> str:
    """How much of the path was measured, and how well, in one sentence."""
    motions = tally.frames - 1
    held, failed, doubtful = (motions - tally.used) / motions, tally.failed / motions, tally.doubtful / motions
    parts = [f"{percent(max(held, 0.0))} hold the last velocity"] if held > 0 else []
    parts += [f"{percent(failed)} failed a check that makes them worthless"] if tally.failed else []
    parts += [f"{percent(doubtful)} are doubtful"] if tally.doubtful else []
    passed = max(0, tally.used - tally.failed - tally.doubtful) / motions
    good = f"{percent(min(passed, 1.0))} of the motions passed every check"
    sentence = ", ".join([good, *parts])
    if held + failed > 1 - TRUSTED_SHARE:
        return f"do not trust this path: {sentence}"
    return (
        f"{sentence}; look at what follows"
        if doubts
        else f"{sentence}; nothing in the images speaks against the method"
    )


@functools.cache
def _worth(alarms: Verdict) -> tuple[bool, bool]:
    """Whether a motion that was measured under these alarms failed, and whether it is only doubtful."""
    failed = gravest(alarms).severity >= Severity.ERROR
    return failed, not failed and gravest(alarms & ~CIRCUMSTANCES).severity >= Severity.WARNING


def percent(share: float) -> str:
    """A share as a percentage for a sentence, never rounded to all or nothing."""
    value = 100 * share
    if 0 < value < 1 or 99 < value < 100:
        return f"{math.floor(value * 10) / 10 if value > 99 else math.ceil(value * 10) / 10:.1f} %"
    return f"{value:.0f} %"


def evaluation_values(result: Evaluation) -> dict[str, Any]:
    """An evaluation as plain values, lengths in metres, angles in degrees."""
    return {
        "matched": result.matched,
        "total": result.total,
        "offset_s": result.offset_ns / 1e9,
        "reference_path_m": result.reference_path_m,
        "path_m": result.path_m,
        "alignment": {
            "rotation_deg": math.degrees(result.alignment.rotation_rad),
            "translation_m": [float(v) for v in result.alignment.translation_m],
            "scale": result.alignment.scale,
            "determined": result.alignment.determined,
        },
        "ape_m": statistics_values(result.ape_m),
        "ape_heading_deg": statistics_values(result.ape_heading_rad, math.degrees(1)),
        "rpe": [relative_values(relative) for relative in result.rpe],
        "end_error_m": result.end_error_m,
        "drift_percent": 100 * result.drift,
        "yaw_drift_deg": math.degrees(result.yaw_drift_rad),
        "yaw_drift_deg_per_m": math.degrees(result.yaw_drift_rad_per_m),
        "notes": list(result.notes),
    }


def statistics_values(statistics: Statistics, factor: float = 1.0) -> dict[str, float | int]:
    """Statistics as plain values, times a factor for another unit."""
    return {
        "rmse": factor * statistics.rmse,
        "mean": factor * statistics.mean,
        "median": factor * statistics.median,
        "max": factor * statistics.max,
        "count": statistics.count,
    }


def relative_values(relative: Relative) -> dict[str, Any]:
    """A relative error as plain values."""
    return {
        "delta": relative.delta,
        "unit": relative.unit,
        "compared": relative.compared,
        "translation_m": statistics_values(relative.translation_m),
        "heading_deg": statistics_values(relative.heading_rad, math.degrees(1)),
    }


def without_nan(value: Any) -> Any:
    """The same values with None for every number that is not finite, as JSON needs it."""
    if isinstance(value, Mapping):
        return {key: without_nan(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The summary of a run as rows of a name and a text, for the terminal and the log."""
    rows = [
        ("recording", f"{summary['recording']} ({summary['format']})"),
        ("estimator", f"{summary['estimator']}, preset {summary['preset']}, run {summary['run']}"),
        ("frames", _frames(summary)),
        ("verdicts", _counts(summary["verdicts"])),
    ]
    if summary["alarms"] != {name: n for name, n in summary["verdicts"].items() if name != "OK"}:
        rows.append(("alarms", _counts(summary["alarms"])))
    if "path_length" in summary:
        rows += [("path length", f"{summary['path_length']:.4g} {summary['unit']}"), ("scale", summary["scale"])]
    rows += _visual_lines(summary["odometry"]) if "odometry" in summary else []
    rows += _range_lines(summary) if "ranging" in summary else _evaluation_lines(summary)
    if summary.get("calibration"):
        told = summary["calibration"]
        rows += [("calibration", text) for text in told.get("sentences", [told["sentence"]])]
    for key, title in (("suitability", "suitability"), ("notes", "note"), ("damage", "damage"), ("facts", "fact")):
        rows += [(title, text) for text in summary[key]]
    if summary["interrupted"]:
        rows.append(("interrupted", "the replay was stopped; everything up to there is in the files"))
    if summary["stopped_early"]:
        rows.append(("stopped early", summary["stopped_early"]))
    return rows


def _frames(summary: Mapping[str, Any]) -> str:
    return f"{summary['frames']} in {summary['duration_s']:.3f} s of {summary['image_stream']}"


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in counts.items()) or "none"


def _evaluation_lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    result = summary["evaluation"]
    if result is None:
        return [("reference", summary["reference"])]
    rows = [
        ("reference", f"{summary['reference']}; {result['matched']} of {result['total']} poses associate"),
        ("APE", _statistics(result["ape_m"], "m", f"after {_alignment(result['alignment'])}")),
    ]
    if result["ape_heading_deg"]["count"]:
        rows.append(("APE heading", _statistics(result["ape_heading_deg"], "°", "")))
    for relative in result["rpe"]:
        if relative["translation_m"]["count"]:
            over = f"over {relative['delta']:g} {relative['unit']} ({relative['compared']})"
            rows.append(("RPE", _statistics(relative["translation_m"], "m", over)))
    drift = "no value" if math.isnan(result["drift_percent"]) else f"{result['drift_percent']:.3g} % of the path"
    rows.append(("drift", f"{drift}: {result['end_error_m']:.4g} m at the end of {result['reference_path_m']:.4g} m"))
    if not math.isnan(result["yaw_drift_deg"]):
        rows.append(("yaw drift", f"{result['yaw_drift_deg']:.3g}°, {result['yaw_drift_deg_per_m']:.3g}°/m"))
    return rows + [("reference", note) for note in result["notes"]]


def _visual_lines(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The start, losses, map and scale of a visual odometry, and its path in space."""
    starts = ", ".join(map(str, found["starts"])) or "never"
    losses = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in found["losses"][:MOST_CAUSES]) or "never"
    more = ", …" if len(found["losses"]) > MOST_CAUSES else ""
    again = ", ".join(map(str, found["relocalised"][:MOST_CAUSES])) or "never"
    rows = [
        ("map", f"{found['keyframes']} keyframes ({found['keyframes_made']} made), {found['map_points']} points at the "
                f"end; started at frame {starts}; {found['maps']} in all"),
        ("tracked", f"median {found['tracked_median']:.0f} points a frame, at least {found['tracked_least']}"
                    if found["frames_with_pose"] else "no frame has a pose"),
        ("lost", f"{losses}{more}; found again: {again}"),
    ]  # fmt: skip
    if 0 < found["frames_without_scale"] < found["frames_with_pose"]:
        told = f"{found['frames_without_scale']} frames before the scale was known are not compared"
        rows.append(("scale", told))
    space = found["space"]
    if space is None:
        return rows
    if "sentence" in space:
        return [*rows, ("in space", space["sentence"])]
    ape, attitude = space["ape_m"], space["attitude_deg"]
    sizes = f"rmse {ape['rmse']:.4g} m ({space['ape_percent']:.3g} % of {space['reference_path_m']:.4g} m)"
    drift = space["scale_drift_percent"]
    drifted = "" if math.isnan(drift) else f", which changes by {drift:.3g} % from the first third to the last"
    of_map = f"map {space['of_map']} alone: " if "of_map" in space else ""
    rows.append(
        ("in space", f"{of_map}{sizes}, max {ape['max']:.4g} m after Sim(3); scale {space['scale']:.5g}{drifted}")
    )
    if "ape_without_scale_m" in space:
        rows.append(("in space", f"rmse {space['ape_without_scale_m']['rmse']:.4g} m after SE(3)"))
    rows.append(
        ("attitude", f"rmse {attitude['rmse']:.3g}°, max {attitude['max']:.3g}°, a constant mounting taken off")
    )
    return rows


def _range_lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The landmarks of a run, all together and one by one."""
    found, nis = summary["ranging"], summary["ranging"]["nis"]
    wait = "" if math.isnan(found["time_to_converge_s"]) else f" after {found['time_to_converge_s']:.3g} s (median)"
    counts = f"{found['updates']} updates, {found['rejected']} rejected, {found['resets']} resets, {found['lost']} lost"
    rows = [
        ("landmarks", f"{found['landmarks']}, started {found['starts']} times; {counts}"),
        (
            "converged",
            f"{found['converged_landmarks']} landmarks{wait}; {percent(found['converged_share'])} of all ranges",
        ),
        (
            "NIS",
            f"mean {nis['mean']:.3g} (each at most 13.8); {nis['expected']:.0f} expected, "
            f"within {nis['low']:.3g}…{nis['high']:.3g} at 95 %",
        ),
        ("reference", summary["reference"]),
    ]
    if found["error"] is not None:
        rows.append(("range error", f"{_range_error(found['error'])} of {found['error']['count']} ranges that count"))
    if summary.get("smoothed") is not None:
        rows += [("smoothed", text) for text in _smoothed(summary["smoothed"])]
    shown = found["per_landmark"][:MOST_LANDMARKS]
    rows += [("landmark", _one_landmark(one)) for one in shown]
    if len(found["per_landmark"]) > len(shown):
        rows.append(("landmark", f"{len(found['per_landmark']) - len(shown)} more; --json prints all"))
    return rows


def _smoothed(told: Mapping[str, Any]) -> list[str]:
    """What smoothing gave; only a sentence where it gave nothing."""
    if not told.get("lives"):
        return [told["sentence"]]
    left_out = f", {told['left_out']} left out" if told["left_out"] else ""
    together = "together" if told["groups"] == 1 else f"in {told['groups']} groups"
    lives = f"{told['landmarks']} landmarks in {told['lives']} lives {together}{left_out}"
    texts = [f"{lives}; {told['iterations']} iterations; {told['sentence']}"]
    if told["error"] is not None:
        texts.append(f"{_range_error(told['error'])} of {told['error']['count']} ranges that count")
    if told["same"] is not None:
        mine, filters = (told["same"][f"{name}_median_percent"] for name in ("smoothed", "filter"))
        count = told["same"]["count"]
        texts.append(f"median {mine:.3g} % where the filter has {filters:.3g} %, on the same {count} ranges")
    return texts


def _one_landmark(one: Mapping[str, Any]) -> str:
    wait = "never converged"
    if not math.isnan(one["time_to_converge_s"]):
        wait = f"converged after {one['time_to_converge_s']:.3g} s"
    starts = f", {one['starts']} starts" if one["starts"] > 1 else ""
    error = "" if one["error"] is None else f"; {_range_error(one['error'])}"
    rejected = f", {one['rejected']} rejected" if one["rejected"] else ""
    nis = f"NIS {one['nis']:.3g} of {one['updates']} updates" if one["updates"] else "no update"
    return f"{one['landmark']}: {wait}{starts}{error}; {nis}{rejected}"


def _range_error(error: Mapping[str, float]) -> str:
    sizes = ", ".join(f"{name} {error[f'{name.lower()}_percent']:.3g} %" for name in ("median", "RMS", "bias"))
    return f"{sizes}, NEES {error['nees']:.3g}, {percent(error['coverage'])} within 2σ"


def _statistics(values: Mapping[str, float], unit: str, what: str) -> str:
    numbers = ", ".join(f"{name} {values[name]:.4g} {unit}" for name in ("rmse", "mean", "median", "max"))
    return f"{numbers} {what}".strip()


def _alignment(alignment: Mapping[str, Any]) -> str:
    scale = f" and scale {alignment['scale']:.4g}" if alignment["scale"] != 1.0 else ""
    return f"alignment in the plane (rotation {alignment['rotation_deg']:.2f}°{scale})"
