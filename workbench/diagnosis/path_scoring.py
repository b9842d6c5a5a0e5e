"""Faults for the correlation odometry: simulated missions with one fault each, and the rule that has to name it.

A mission is a short drive over flat ground. Its seed decides ground, way, speed profile, when the fault begins, how
long it lasts and how strong it is, within a range in which it matters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import CorrelationSettings
from pipelines.evaluation import Trajectory
from pipelines.replay import replay
from pipelines.simulation.mission import IMAGE, PAPER_HEIGHT_M, POSE, SimulatedMission
from pipelines.simulation.scenario import Scenario, build
from readers.streams import PoseSample
from workbench.diagnosis.finding import Bools, Case, Ints
from workbench.diagnosis.scoring import CLEAN, Planted, Trial

Rng = np.random.Generator
Values = dict[str, Any]
Makes = Callable[[Rng], Values]
AtFault = Callable[[SimulatedMission, Ints], Bools]

FRAMES, RATE_HZ, SIDE_PX = 100, 60.0, 256
FAMILIES = ("gravel", "wood", "grass", "soil", "sand", "mud", "concrete", "street")
CURVES: Mapping[str, Mapping[str, float]] = {
    "line": {},
    "circle": {"radius_m": 1.2},
    "serpentine": {"amplitude_m": 0.1, "wavelength_m": 2.0},
    "wander": {},
}
PAPER_SPAN_PX = 100.0
"""Distance of the two fragments of ``paper-a`` in these small images."""

LEFT_OUT: Mapping[str, str] = {
    "odometer-scale": "the odometry reads no wheels",
    "gyro-bias": "the odometry reads no gyro",
    "late-images, all of them": "a constant delay moves images and path alike; only a reference with its own clock "
    "shows it, as a time offset (`--offset`), not a frame",
    "repetitive-texture, period beyond the search": "the rival peak is out of reach: the match is right",
    "motion-blur along the grain of wood": "there is nothing to smear: match and motion stay as they are",
    "shift-jump within the search": "it is motion like any other, and measured rightly",
    "turn-jump below the limit": "it is motion like any other, and measured rightly",
    "track-slip, track-outliers": "the odometry reads no tracks",
}


# ---------------------------------------------------------------------------------- missions


def scenario(seed: int, values: Values) -> Scenario:
    """The mission of a seed, with some values of its own."""
    rng = np.random.default_rng((seed, 1))
    way = str(rng.choice(list(CURVES)))
    usual: Values = {
        "name": f"scored {seed}",
        "seed": seed,
        "frames": FRAMES,
        "ground": {"family": FAMILIES[seed % len(FAMILIES)], "size_px": 512},
        "camera": {"width_px": SIDE_PX, "height_px": SIDE_PX, "timing": {"rate_hz": RATE_HZ}},
        "trajectory": {"curve": way, "parameters": CURVES[way], "profile_parameters": {"ramp_s": 0.25}},
        "reference": {"timing": {"rate_hz": RATE_HZ}},
    }
    for section in ("ground", "camera", "trajectory"):
        usual[section] |= values.get(section, {})
    return Scenario.model_validate(usual | {"faults": values.get("faults", [])})


def settings_for(mission: SimulatedMission, preset: str) -> CorrelationSettings:
    """A preset with the scale that the mission's calibration gives."""
    sent = mission.cameras[IMAGE]
    values: Values = {"focal_px": float(sent.matrix[0, 0]), "height_m": PAPER_HEIGHT_M}
    if preset == "paper-a":
        values["span_u_px"] = PAPER_SPAN_PX
    return CorrelationSettings.preset(preset).model_copy(update=values)


def case_of(mission: SimulatedMission, settings: CorrelationSettings) -> Case:
    """Replay a mission in memory, as the rules see it."""
    steps = [replayed.step for replayed in replay(mission, CorrelationOdometry(settings), image_stream=IMAGE)]
    poses = (sample for sample in mission.read([POSE]) if isinstance(sample, PoseSample))
    reference = Trajectory.of_poses(poses)
    return Case.of_steps(steps, "correlation", settings.model_dump(mode="json"), reference)


def trial(make: Makes, at_fault: AtFault, preset: str, seed: int) -> Trial:
    """The trial of a seed: its mission with the values that `make` draws."""
    mission = build(scenario(seed, make(np.random.default_rng((seed, 2)))))
    case = case_of(mission, settings_for(mission, preset))
    return Trial(case, at_fault(mission, case.t_ns))


# ------------------------------------------------------------------- at which frames a fault is


def during(mission: SimulatedMission, t_ns: Ints) -> Bools:
    """The frames [n] taken while a fault lasts; of one on the ground, while any of it is in view."""
    found = np.zeros(len(t_ns), dtype=bool)
    for fault in mission.faults:
        for start_s, stop_s in getattr(fault, "in_view_s", ()) or ((fault.start_s, fault.stop_s),):
            found |= _between(mission, t_ns, start_s, stop_s)
    return found


def at_the_edges(mission: SimulatedMission, t_ns: Ints) -> Bools:
    """The first frame of a pulse and the first one after it: there the vehicle leaps."""
    found = np.zeros(len(t_ns), dtype=bool)
    for fault in mission.faults:
        for edge_s in (fault.start_s, fault.stop_s):
            found |= _between(mission, t_ns, edge_s, edge_s + 1.0 / RATE_HZ)
    return found


def behind(mission: SimulatedMission, t_ns: Ints) -> Bools:
    """The first frame after the images that were lost."""
    found = np.zeros(len(t_ns), dtype=bool)
    for fault in mission.faults:
        found[np.searchsorted(t_ns, mission.start_ns + round(fault.stop_s * 1e9))] = True
    return found


def at_the_start(mission: SimulatedMission, t_ns: Ints) -> Bools:
    """The first frame of a fault."""
    found = np.zeros(len(t_ns), dtype=bool)
    for fault in mission.faults:
        found[np.searchsorted(t_ns, mission.start_ns + round(fault.start_s * 1e9))] = True
    return found


def always(mission: SimulatedMission, t_ns: Ints) -> Bools:
    """All frames."""
    return np.ones(len(t_ns), dtype=bool)


def never(mission: SimulatedMission, t_ns: Ints) -> Bools:
    """No frame."""
    return np.zeros(len(t_ns), dtype=bool)


def _between(mission: SimulatedMission, t_ns: Ints, start_s: float, stop_s: float) -> Bools:
    seconds = (t_ns - mission.start_ns) * 1e-9
    return np.asarray((start_s - 1e-6 <= seconds) & (seconds < stop_s - 1e-6))


# ------------------------------------------------------------------------------------- table


def fault(
    kind: str,
    draw: Callable[[Rng], Values],
    length_s: tuple[float, float] = (0.25, 0.45),
    start_s: tuple[float, float] = (0.7, 1.0),
) -> Makes:
    """One fault from a time on, for so and so long, both from their ranges, with the parameters that `draw` draws."""

    def make(rng: Rng) -> Values:
        begin_s = float(rng.uniform(*start_s))
        end_s = begin_s + float(rng.uniform(*length_s))
        return {"faults": [{"kind": kind, "start_s": begin_s, "stop_s": end_s, **draw(rng)}]}

    return make


def in_between(name: str, low: float, high: float, **more: Any) -> Callable[[Rng], Values]:
    """A parameter from a range."""
    return lambda rng: {name: float(rng.uniform(low, high)), **more}


def either_way(name: str, low: float, high: float, **more: Any) -> Callable[[Rng], Values]:
    """A parameter whose size is from a range, of either sign."""
    return lambda rng: {name: float(rng.uniform(low, high) * rng.choice([-1.0, 1.0])), **more}


def _pattern(pattern: str, periods_px: tuple[int, ...]) -> Callable[[Rng], Values]:
    return lambda rng: {"pattern": pattern, "period_px": int(rng.choice(periods_px)), "margin_m": 0.5}


def _gain(rng: Rng) -> Values:
    return {"gain": float(rng.choice([rng.uniform(0.5, 0.8), rng.uniform(1.2, 1.8)]))}


def _push(rng: Rng) -> Values:
    size_m, angle = rng.uniform(0.012, 0.04), rng.uniform(-np.pi, np.pi)
    return {"forward_m": float(size_m * np.cos(angle)), "left_m": float(size_m * np.sin(angle))}


def _not_on_wood(make: Makes) -> Makes:
    """On a ground without a grain."""
    grounds = [family for family in FAMILIES if family != "wood"]
    return lambda rng: make(rng) | {"ground": {"family": str(rng.choice(grounds))}}


def _nothing(rng: Rng) -> Values:
    return {}


def _whole(kind: str, name: str, low: float, high: float) -> Makes:
    """A fault throughout, by a factor of 1 ± low…high."""

    def make(rng: Rng) -> Values:
        factor = 1.0 + float(rng.uniform(low, high) * rng.choice([-1.0, 1.0]))
        return {"faults": [{"kind": kind, "start_s": 0.0, "stop_s": 1e3, name: factor}]}

    return make


def _section(section: str, name: str, low: float, high: float) -> Makes:
    """No fault, but a value of the mission itself that is off by ± low…high."""
    draw = either_way(name, low, high)
    return lambda rng: {section: draw(rng)}


def _late(rng: Rng) -> Values:
    latency_s = float(rng.uniform(0.03, 0.1))
    return {
        "faults": [
            {"kind": "late-images", "start_s": float(rng.uniform(0.7, 1.0)), "stop_s": 1e3, "latency_s": latency_s}
        ]
    }


def planted(preset: str = "best") -> tuple[Planted, ...]:
    """The faults of the odometry, and the rules that have to name them."""

    def row(fault: str, rule: str, make: Makes, at_fault: AtFault, strength: str) -> Planted:
        return Planted(fault=fault, rule=rule, trial=partial(trial, make, at_fault, preset), strength=strength)

    blink_s = (0.035, 0.1)
    return (
        row(CLEAN, "", _nothing, never, ""),
        row("repetitive-texture, tiles", "repetitive-texture", fault("repetitive-texture", _pattern("tiles", (6, 8))),
            during, "period 6 or 8 px, within the search"),
        row("repetitive-texture, stripes", "aperture",
            fault("repetitive-texture", _pattern("stripes", (8, 12, 16))), during, "period 8, 12 or 16 px"),
        row("low-texture", "low-texture", fault("low-texture", in_between("gradient_rms", 0.2, 0.6, margin_m=0.5)),
            during, "gradient 0.2…0.6 grey/px, noise 2 grey"),
        row("shift-jump", "shift-beyond-search", fault("shift-jump", _push), at_the_edges, "12…40 mm (15…51 px)"),
        row("turn-jump", "rotation-beyond-limit", fault("turn-jump", either_way("turn_rad", 0.05, 0.2)),
            at_the_edges, "±0.05…0.2 rad; limit 0.035"),
        row("height-change", "height-change", fault("height-change", either_way("lift_m", 0.006, 0.03, ramp_s=0.08)),
            during, "±3…15 % of the height"),
        row("motion-blur", "motion-blur", _not_on_wood(fault("motion-blur", in_between("exposure", 0.7, 1.0))),
            during, "0.7…1 of the interval, not on wood"),
        row("exposure-jump", "exposure-jump", fault("exposure-jump", _gain), during, "gain 0.5…0.8 or 1.2…1.8"),
        row("image-noise", "image-noise", fault("image-noise", in_between("noise_grey", 8.0, 25.0)), during,
            "8…25 grey (usual: 2)"),
        row("lens-dirt", "lens-dirt", fault("lens-dirt", in_between("share", 0.35, 0.6)), during, "share 0.35…0.6"),
        row("dropped-frames", "dropped-frames", fault("dropped-frames", _nothing, blink_s), behind, "2…6 images"),
        row("duplicate-frames", "duplicate-frames", fault("duplicate-frames", _nothing, blink_s), during,
            "2…6 images"),
        row("swapped-stamps", "swapped-stamps", fault("swapped-stamps", _nothing), during, "7…13 pairs"),
        row("late-images, from then on", "stamp-jump", _late, at_the_start, "0.03…0.1 s"),
        row("wrong-calibration", "wrong-scale", _whole("wrong-calibration", "focal_factor", 0.03, 0.1), always,
            "focal length ±3…10 %, with a reference"),
        row("camera mounted with a yaw", "mounting-yaw", _section("camera", "yaw_rad", 0.05, 0.3), always,
            "±0.05…0.3 rad, with a reference"),
        row("camera mounted with a pitch", "tilt", _section("camera", "pitch_rad", 0.03, 0.1), always,
            "±0.03…0.1 rad"),
        row("sideslip", "side-slip", _section("trajectory", "sideslip_rad", 0.1, 0.3), always, "±0.1…0.3 rad"),
    )  # fmt: skip
