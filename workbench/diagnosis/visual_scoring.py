"""Faults for the semi-direct odometry: short simulated flights with one fault each, and the rule that has to name it.

A flight is two and a half seconds at 1.5 m over flat ground, swaying. Its seed decides ground, speed, heading of the
way, when the fault begins, how long it lasts and how strong it is, within a range in which it matters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from pipelines.evaluation import Trajectory
from pipelines.replay import replay
from pipelines.semidirect.odometry import SemidirectOdometry
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.simulation.mission import HEIGHT, IMAGE, POSE, SimulatedMission
from pipelines.simulation.scenario import Scenario, build
from readers.streams import PoseSample
from workbench.diagnosis.finding import Case
from workbench.diagnosis.path_scoring import (
    AtFault,
    Makes,
    Rng,
    Values,
    always,
    at_the_start,
    behind,
    during,
    either_way,
    fault,
    in_between,
    never,
)
from workbench.diagnosis.scoring import CLEAN, Planted, Trial

FRAMES, RATE_HZ = 150, 60.0
WIDTH_PX, HEIGHT_PX, FOCAL_PX, ABOVE_M = 480, 320, 268.0, 1.5
FAMILIES = ("gravel", "grass", "soil", "concrete")
SWAY: Values = {"height_rms_m": 0.04, "height_tau_s": 2.0, "roll_rms_rad": 0.03, "roll_tau_s": 0.5,
                "pitch_rms_rad": 0.03, "pitch_tau_s": 0.5}  # fmt: skip
SMALL: Values = {"cell_px": 24, "start_motion_px": 32.0}
"""Settings for images of this size, whatever the preset."""

LEFT_OUT: Mapping[str, str] = {
    "repetitive-texture": "points move by less than half a period between frames, so that they are not confounded",
    "lens-dirt": "the ground is seen through it, and tracked: at the most it is told as less sharp (`blur`)",
    "height-change": "it is motion like any other, and measured rightly",
    "odometer-scale, gyro-bias": "the odometry reads no wheels and no gyro",
    "track-slip, track-outliers": "the odometry reads no tracks",
}


def scenario(seed: int, values: Values) -> Scenario:
    """The flight of a seed, with some values of its own."""
    rng = np.random.default_rng((seed, 1))
    usual: Values = {
        "name": f"scored {seed}",
        "seed": seed,
        "frames": values.get("frames", FRAMES),
        "ground": {"family": FAMILIES[seed % len(FAMILIES)], "size_px": 512, "metres_per_px": 0.0035},
        "camera": {"width_px": WIDTH_PX, "height_px": HEIGHT_PX, "focal_px": FOCAL_PX, "height_m": ABOVE_M,
                   "timing": {"rate_hz": RATE_HZ}},
        "trajectory": {"curve": "wander", "parameters": {"amplitude_m": 0.5, "wavelength_m": 8.0}, "profile": "waves",
                       "speed_kmh": float(rng.uniform(4.0, 6.0))},
        "body": SWAY,
        "reference": {"timing": {"rate_hz": RATE_HZ}},
        "height": {"timing": {"rate_hz": RATE_HZ}},
    }  # fmt: skip
    for section in ("ground", "camera", "trajectory", "body"):
        usual[section] = values[f"{section}!"] if f"{section}!" in values else usual[section] | values.get(section, {})
    return Scenario.model_validate(usual | {"faults": values.get("faults", [])})


def settings_for(mission: SimulatedMission, preset: str, values: Values) -> SemidirectSettings:
    """A preset with the calibration that the mission sends, and with its sensor of heights."""
    sent = mission.cameras[IMAGE]
    known: Values = {
        "focal_px": float(sent.matrix[0, 0]),
        "centre_px": (float(sent.matrix[0, 2]), float(sent.matrix[1, 2])),
        "image_size_px": (sent.width_px, sent.height_px),
        "height_stream": HEIGHT,
    }
    return SemidirectSettings.preset(preset).model_copy(update=SMALL | known | values.get("settings", {}))


def case_of(mission: SimulatedMission, settings: SemidirectSettings) -> Case:
    """Replay a flight in memory, as the rules see it."""
    streams = [settings.height_stream] if settings.height_stream else []
    replayed = replay(mission, SemidirectOdometry(settings), image_stream=IMAGE, other_streams=streams)
    steps = [one.step for one in replayed]
    poses = (sample for sample in mission.read([POSE]) if isinstance(sample, PoseSample))
    return Case.of_steps(steps, "semidirect", settings.model_dump(mode="json"), Trajectory.of_poses(poses))


def trial(make: Makes, at_fault: AtFault, preset: str, seed: int) -> Trial:
    """The trial of a seed: its flight with the values that `make` draws."""
    values = make(np.random.default_rng((seed, 2)))
    mission = build(scenario(seed, values))
    case = case_of(mission, settings_for(mission, preset, values))
    return Trial(case, at_fault(mission, case.t_ns))


# ------------------------------------------------------------------------------------- table


def _fault(kind: str, draw: Callable[[Rng], Values], length_s: tuple[float, float] = (0.15, 0.4)) -> Makes:
    """One fault, begun when there is a map."""
    return fault(kind, draw, length_s, start_s=(1.2, 1.5))


def _nothing(rng: Rng) -> Values:
    return {}


def _brighter(rng: Rng) -> Values:
    return {"gain": float(rng.choice([rng.uniform(0.2, 0.4), rng.uniform(1.9, 2.4)]))}


def _slightly_brighter(rng: Rng) -> Values:
    return {"gain": float(rng.choice([rng.uniform(0.88, 0.92), rng.uniform(1.08, 1.12)]))}


def _fast(make: Makes) -> Makes:
    return lambda rng: make(rng) | {"trajectory": {"speed_kmh": float(rng.uniform(10.0, 14.0))}}


def _no_picture(rng: Rng) -> Values:
    """Black frames, or white ones."""
    return {"gain": 0.0} if rng.random() < 0.5 else {"gain": 1.0, "offset_grey": 250.0}


def _elsewhere(rng: Rng) -> Values:
    """Pushed by more than the width of the image."""
    return {"forward_m": float(rng.uniform(3.0, 5.0)), "left_m": float(rng.uniform(-1.0, 1.0))}


def _turning(rng: Rng) -> Values:
    angle = float(rng.uniform(0.5, 1.2) * rng.choice([-1.0, 1.0]))
    return {"trajectory!": {"legs": [{"turn_rad": angle, "turn_s": 2.5}], "speed_kmh": 2.0}, "body!": {}}


def _standing(rng: Rng) -> Values:
    return {"trajectory!": {"legs": [{"stop_s": 2.5}], "speed_kmh": 2.0}, "body!": {}}


def _wrong_focal(rng: Rng) -> Values:
    factor = 1.0 + float(rng.uniform(0.08, 0.2) * rng.choice([-1.0, 1.0]))
    return {"faults": [{"kind": "wrong-calibration", "start_s": 0.0, "stop_s": 1e3, "focal_factor": factor}]}


def _wrong_height(rng: Rng) -> Values:
    return {"settings": {"height_offset_m": float(rng.uniform(0.15, 0.4) * rng.choice([-1.0, 1.0]))}}


def _no_height(rng: Rng) -> Values:
    return {"settings": {"height_stream": ""}}


def planted(preset: str = "fast") -> tuple[Planted, ...]:
    """The faults of the semi-direct odometry, and the rules that have to name them."""

    def row(fault: str, rule: str, make: Makes, at_fault: AtFault, strength: str, *also: str) -> Planted:
        return Planted(
            fault=fault,
            rule=rule,
            trial=partial(trial, make, at_fault, preset),
            strength=strength,
            also=frozenset(also),
        )

    after = ("after-relocalisation", "new-map", "few-points")
    long_s, rest_s = (0.8, 1.0), (4.0, 5.0)
    bare = _fault("low-texture", in_between("gradient_rms", 0.0, 0.1, margin_m=3.0), rest_s)
    late = _fault("late-images", in_between("latency_s", 0.03, 0.1), rest_s)
    return (
        row(CLEAN, "", _nothing, never, ""),
        row("dropped-frames, few", "frame-gap", _fault("dropped-frames", _nothing, (0.02, 0.07)), behind, "1…4 images"),
        row("dropped-frames, many", "lost-frame-gap", _fault("dropped-frames", _nothing, long_s), behind,
            "0.8…1 s", *after),
        row("repeated frames", "repeated-frames", _fault("duplicate-frames", _nothing, (0.035, 0.1)), during,
            "2…6 images"),
        row("late-images, from then on", "frame-gap", late, at_the_start, "0.03…0.1 s"),
        row("swapped-stamps", "swapped-stamps", _fault("swapped-stamps", _nothing), during, "4…12 pairs"),
        row("exposure-jump, slight", "exposure", _fault("exposure-jump", _slightly_brighter), during,
            "gain 0.88…0.92 or 1.08…1.12"),
        row("exposure-jump", "lost-exposure", _fault("exposure-jump", _brighter), during, "gain 0.2…0.4 or 1.9…2.4",
            "exposure", *after),
        row("no picture", "lost-exposure", _fault("exposure-jump", _no_picture), during, "black or white frames",
            "exposure", *after),
        row("motion-blur", "blur", _fast(_fault("motion-blur", in_between("exposure", 0.8, 1.0))), during,
            "0.8…1 of the interval at 10…14 km/h"),
        row("image-noise", "image-noise", _fault("image-noise", in_between("noise_grey", 15.0, 30.0)), during,
            "15…30 grey (usual: 2)"),
        row("low-texture", "lost-flat", _fast(bare),
            during, "gradient 0…0.1 grey/px, noise 2 grey", *after),
        row("other place", "lost-unlike", _fault("shift-jump", _elsewhere, (0.5, 0.9)), during, "3…5 m", *after),
        row("turn-jump", "lost-unlike", _fault("turn-jump", either_way("turn_rad", 0.6, 1.5), (0.3, 0.6)), during,
            "±0.6…1.5 rad", *after),
        row("turning only", "start-failed", _turning, always, "0.5…1.2 rad in 2.5 s, from the start"),
        row("standing still", "start-failed", _standing, always, "from the start"),
        row("wrong-calibration", "wrong-scale", _wrong_focal, always, "focal length ±8…20 %, with a reference",
            "scale-drift", "scale-drift-by-reference"),
        row("wrong height", "wrong-scale", _wrong_height, always, "±0.15…0.4 m, with a reference"),
        row("no height", "scale-unknown", _no_height, always, ""),
    )  # fmt: skip
