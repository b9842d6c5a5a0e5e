"""A recorded flight: what its camera has seen, and how it kept to its plan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from shapely.geometry.base import BaseGeometry

from pipelines.patrol.coverage import Coverage, Looks, coverage, forward_overlaps, gaps
from pipelines.patrol.flown import Beside, beside, flown_shares
from pipelines.patrol.footprint import View
from pipelines.patrol.place import Origin
from pipelines.patrol.plan import Plan
from readers.streams import Camera, GnssSample, OdometrySample, PoseSample, Recording, StreamError, StreamKind
from workbench.inputs import names, of_kind, while_readable
from workbench.patrol.areas import Placed
from workbench.patrol.saved import Saved
from workbench.settings import SettingsError

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

CELLS_A_FOOTPRINT = 40
"""Cells along the shorter side of a middling footprint, unless a size is given."""
PLACE_KINDS = (StreamKind.POSE, StreamKind.GNSS, StreamKind.ODOMETRY)
AROUND_M = 10.0
"""The direction of travel is taken over so many metres before and after a place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What a flight is judged by.

    Attributes:
        poses: stream of the places; None for the only pose, GNSS or odometry stream.
        images: stream of the pictures; None for the only one, ``none`` for one at each place.
        view_rad: angles of view across and along the way of flight; None for those of the recording's camera, or
            of the plan.
        across_px: pixels across; NaN where not known.
        height_m: height over ground; None for that of the poses, or of the plan for want of altitudes.
        ground_m: height of the ground in the places' coordinates; for GNSS its altitude.
        yaw_rad: turn of the camera against the body or the direction of travel, counter-clockwise.
        cell_m: side of a cell; None for one that suits the footprint.
        from_first: whether the first place is the plan's first way point.
    """

    poses: str | None = None
    images: str | None = None
    view_rad: tuple[float, float] | None = None
    across_px: float = math.nan
    height_m: float | None = None
    ground_m: float | None = None
    yaw_rad: float = 0.0
    cell_m: float | None = None
    from_first: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Where the vehicle was: `t_ns` [n], `position_m` [n, 3], `world_r_body` [n, 3, 3]; how that was found."""

    t_ns: Longs
    position_m: Floats
    world_r_body: Floats
    origin: Origin | None
    notes: tuple[str, ...]

    @property
    def length_m(self) -> float:
        """Length of the path, seen from above."""
        return float(np.hypot(*np.diff(self.position_m[:, :2], axis=0).T).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """What came of it; `beside`, `flown` and `plan` are None without a plan, `target` without any area."""

    track: Track
    looks: Looks
    found: Coverage
    overlaps: Floats
    target: BaseGeometry | None
    gaps: list[BaseGeometry]
    ground_m: float
    plan: Plan | None
    beside: Beside | None
    flown: Floats | None
    notes: tuple[str, ...]


def evaluate(
    recording: Recording, asked: Asked, *, saved: Saved | None = None, placed: Placed | None = None
) -> Evaluation:
    """What a recorded flight has seen, of an area or of its plan's.

    Raises:
        StreamError: a stream that is missing, or of which there are several.
        SettingsError: what is needed is not known; the text names the option.
    """
    given = saved.origin if saved is not None else placed.origin if placed is not None else None
    first = saved.plan.flights[0].points[0] if saved is not None and asked.from_first else None
    track = _track(recording, asked, given)
    if first is not None:
        moved = track.position_m + np.append(first - track.position_m[0, :2], 0.0)
        track = Track(track.t_ns, moved, track.world_r_body, track.origin, (*track.notes, "moved to the plan's begin"))
    times, told = _pictures(recording, asked, track)
    looks, outside = _looks(track, times)
    view, seen_by = _view(recording, asked, saved)
    ground, height_text = _ground(asked, saved, looks, track)
    if asked.height_m is not None:
        looks.position_m[:, 2] = ground + asked.height_m
    target = placed.area.target if placed is not None else saved.plan.task.area.target if saved is not None else None
    try:
        cell = asked.cell_m or _cell(view, looks, ground)
        found = coverage(view, looks, cell_m=cell, ground_m=ground)
    except ValueError as error:
        raise SettingsError(f"{recording.path}: {error}") from error
    notes = [*track.notes, told, seen_by, height_text]
    notes += [f"{outside} pictures lie outside the time of the places and are left out"] if outside else []
    notes += (
        [f"{len(found.without)} pictures have no footprint: {next(iter(found.without.values()))}"]
        if found.without
        else []
    )
    plan = saved.plan if saved is not None else None
    return Evaluation(
        track=track,
        looks=looks,
        found=found,
        overlaps=forward_overlaps(found),
        target=target,
        gaps=gaps(found, target),
        ground_m=ground,
        plan=plan,
        beside=None if plan is None else beside(track.position_m[:, :2], plan),
        flown=None if plan is None else flown_shares(track.position_m[:, :2], plan, plan.task.strip.swath_m / 4),
        notes=tuple(notes),
    )


# ---------------------------------------------------------------------------------- places


def _stream_of_places(recording: Recording, wanted: str | None) -> str:
    if wanted is not None:
        return of_kind(recording, wanted, PLACE_KINDS, "--poses")
    for kind in PLACE_KINDS:
        found = recording.of_kind(kind)
        if len(found) > 1:
            raise StreamError(f"{recording.path}: several {kind} streams ({names(found)}); choose one with --poses")
        if found:
            return found[0].name
    raise StreamError(f"{recording.path}: no poses, GNSS or odometry, so that nobody knows where it flew")


def _track(recording: Recording, asked: Asked, origin: Origin | None) -> Track:
    stream = _stream_of_places(recording, asked.poses)
    samples = list(while_readable(recording.read([stream])))
    fixes = [s for s in samples if isinstance(s, GnssSample) and s.status >= 0 and math.isfinite(s.latitude_rad)]
    posed = [s for s in samples if isinstance(s, PoseSample | OdometrySample) and np.isfinite(s.position_m[:2]).all()]
    t_ns = np.array([s.t_ns for s in (*fixes, *posed)], np.int64)
    if len(t_ns) < 2:
        raise StreamError(f"{recording.path}: {stream} holds fewer than two places; choose another with --poses")
    if fixes:
        origin = origin or Origin(fixes[0].latitude_rad, fixes[0].longitude_rad, 0.0)
        degrees = np.array([(f.latitude_rad, f.longitude_rad, f.altitude_m) for f in fixes])
        position = origin.enu(degrees[:, 0], degrees[:, 1], np.nan_to_num(degrees[:, 2], nan=origin.altitude_m))
        position[:, 2] = degrees[:, 2]
        quats = np.full((len(fixes), 4), np.nan)
    else:
        position, quats = np.array([s.position_m for s in posed]), np.array([s.quat_xyzw for s in posed])
    t_ns, kept = np.unique(t_ns, return_index=True)
    position, quats = position[kept], quats[kept]
    oriented = bool(np.isfinite(quats).all() and (np.linalg.norm(quats, axis=1) > 0.5).all())
    turns = Rotation.from_quat(quats) if oriented else _about_z(_courses(position[:, :2]))
    how = "attitudes as recorded" if oriented else "level, heading where it travels: no attitude is recorded"
    turns = turns * _about_z(np.array([asked.yaw_rad]))
    note = f"places of {stream}, {len(t_ns)} of them; {how}"
    return Track(t_ns, position, turns.as_matrix(), origin if fixes else None, (note,))


def _about_z(angles_rad: Floats) -> Rotation:
    """Rotations [n] about the vertical."""
    return Rotation.from_rotvec(np.outer(angles_rad, [0.0, 0.0, 1.0]))


def _courses(points: Floats) -> Floats:
    """Direction of travel [n] at places [n, 2], over `AROUND_M` before and after each; held where it stands."""
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    last = np.clip(np.searchsorted(gone, gone + AROUND_M), 0, len(points) - 1)
    first = np.clip(np.searchsorted(gone, gone - AROUND_M, side="right") - 1, 0, len(points) - 1)
    way = points[last] - points[first]
    return np.arctan2(way[:, 1], way[:, 0])


def _pictures(recording: Recording, asked: Asked, track: Track) -> tuple[Longs, str]:
    """Times of the pictures, and where they are from."""
    streams = recording.of_kind(StreamKind.IMAGE)
    if asked.images == "none" or (asked.images is None and not streams):
        return track.t_ns, f"a picture supposed at each place, {'as asked' if streams else 'for want of images'}"
    if asked.images is None and len(streams) > 1:
        raise StreamError(
            f"{recording.path}: several image streams ({names(streams)}); choose one with --image, or none"
        )
    name = streams[0].name if asked.images is None else of_kind(recording, asked.images, (StreamKind.IMAGE,), "--image")
    times = np.array([s.t_ns for s in while_readable(recording.read([name]))], np.int64)
    return np.unique(times), f"pictures of {name}, {len(times)} of them"


def _looks(track: Track, times: Longs) -> tuple[Looks, int]:
    """Where the camera was at the pictures within the time of the places, and how many lie outside."""
    inside = times[(times >= track.t_ns[0]) & (times <= track.t_ns[-1])]
    if not len(inside):
        raise SettingsError(
            "no picture lies within the time of the places; choose another stream with --poses or --image"
        )
    seconds, at = (track.t_ns - track.t_ns[0]) / 1e9, (inside - track.t_ns[0]) / 1e9
    position = np.column_stack([np.interp(at, seconds, column) for column in track.position_m.T])
    turns = Slerp(seconds, Rotation.from_matrix(track.world_r_body))(at).as_matrix()
    return Looks(inside, position, turns), len(times) - len(inside)


# ---------------------------------------------------------------------------------- camera


def _view(recording: Recording, asked: Asked, saved: Saved | None) -> tuple[View, str]:
    """The camera: as asked, the recording's own, or the plan's; and a sentence on it."""
    if asked.view_rad is not None:
        return _of_angles(asked.view_rad, asked.across_px), _angles_text(asked.view_rad, "as given")
    camera = _camera(recording, asked.images)
    if camera is not None:
        mounted = bool(np.isfinite(camera.body_t_camera).all())
        turn = camera.body_t_camera[:3, :3] if mounted else ACROSS
        text = "mounted as recorded" if mounted else "supposed to look straight down, the image's width across the way"
        try:
            return View.of_camera(camera, turn), f"the recording's camera, {text}"
        except ValueError as error:
            raise SettingsError(f"{recording.path}: {error}; or give --fov") from error
    if saved is not None and all(map(math.isfinite, saved.view_rad)):
        return _of_angles(saved.view_rad, asked.across_px), _angles_text(saved.view_rad, "the plan's")
    raise SettingsError(f"{recording.path}: its camera is not calibrated: give its angles of view with --fov 69x55")


ACROSS = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
"""body_r_camera of a camera that looks straight down, the top of its image ahead: u to the right, v back."""


def _of_angles(angles: tuple[float, float], across_px: float) -> View:
    try:
        return View.of_angles(*angles, across_px=across_px)
    except ValueError as error:
        raise SettingsError(f"--fov: {error}") from error


def _angles_text(angles: tuple[float, float], whose: str) -> str:
    across, along = map(math.degrees, angles)
    return f"a camera straight down that sees {across:.1f}° across and {along:.1f}° along the way, {whose}"


def _camera(recording: Recording, wanted: str | None) -> Camera | None:
    known = {name: camera for name, camera in recording.cameras.items() if camera.calibrated and camera.width_px > 0}
    if wanted in known:
        return known[wanted]
    return next(iter(known.values())) if len(known) == 1 else None


def _ground(asked: Asked, saved: Saved | None, looks: Looks, track: Track) -> tuple[float, str]:
    """Height of the ground in the places' coordinates; the looks get a height where it is not that of the places."""
    if asked.height_m is not None:
        return asked.ground_m or 0.0, f"{asked.height_m:g} m over ground, as given"
    if asked.ground_m is not None:
        return asked.ground_m, f"the ground at {asked.ground_m:g} m, as given"
    if track.origin is None:
        return 0.0, "the ground at z = 0 of the places"
    if saved is not None:
        looks.position_m[:, 2] = saved.height_m
        return 0.0, f"{saved.height_m:g} m over ground, the plan's height"
    low, high = float(np.nanmin(looks.position_m[:, 2])), float(np.nanmax(looks.position_m[:, 2]))
    raise SettingsError(
        f"the flight's altitudes ({low:.0f} to {high:.0f} m) do not tell its height over ground: give the ground's "
        "altitude with --ground, or the height with --height"
    )


def _cell(view: View, looks: Looks, ground_m: float) -> float:
    """A round cell: a part of the shorter side of a middling footprint."""
    sides = []
    for position, turn in zip(looks.position_m, looks.world_r_body, strict=True):
        try:
            sides.append(float(np.ptp(view.footprint(position, turn, ground_m), axis=0).min()))
        except ValueError:
            continue
    if not sides:
        view.footprint(looks.position_m[0], looks.world_r_body[0], ground_m)
    wanted = float(np.median(sides)) / CELLS_A_FOOTPRINT
    power = 10.0 ** math.floor(math.log10(wanted))
    return next(n * power for n in (5, 2, 1) if n * power <= wanted)


# --------------------------------------------------------------------------------- figures


def values(done: Evaluation) -> dict[str, Any]:
    """The evaluation as plain values."""
    found = done.found
    seen = found.count > 0
    cell_area = found.cell_m**2
    inside = found.within(done.target) if done.target is not None else seen
    counted = found.count[inside & seen]
    fine = found.best_m[inside & seen]
    overlaps = done.overlaps[np.isfinite(done.overlaps)]
    result: dict[str, Any] = {
        "pictures": len(done.looks.t_ns),
        "footprints": len(found.footprints),
        "flown_m": done.track.length_m,
        "flown_s": float(done.track.t_ns[-1] - done.track.t_ns[0]) / 1e9,
        "cell_m": found.cell_m,
        "seen_m2": float(found.seen.area),
        "height_m": _spread(done.looks.position_m[:, 2] - done.ground_m),
        "times_seen": _spread(counted),
        "seen_once_m2": float((counted == 1).sum() * cell_area),
        "seen_three_times_m2": float((counted >= 3).sum() * cell_area),
        "sample_distance_m": _spread(fine[np.isfinite(fine)]),
        "forward_overlap": _spread(overlaps),
        "steps_without_overlap": int((overlaps <= 0).sum()),
        "gaps": len(done.gaps),
        "gaps_m2": float(sum(gap.area for gap in done.gaps)),
        "largest_gaps": [
            {"x_m": float(gap.centroid.x), "y_m": float(gap.centroid.y), "area_m2": float(gap.area)}
            for gap in done.gaps[:5]
        ],
        "notes": list(done.notes),
    }
    if done.target is not None:
        result |= {
            "target_m2": float(done.target.area),
            "covered_share": float(found.seen.intersection(done.target).area / done.target.area),
            "seen_outside_m2": float(found.seen.difference(done.target).area),
        }
    if done.plan is not None and done.beside is not None and done.flown is not None:
        cross = done.beside.cross_m[done.beside.sweeping]
        result["against_plan"] = {
            "planned_m": sum(flight.length_m for flight in done.plan.flights),
            "planned_s": max(done.plan.task.vehicle.duration_s(flight.points) for flight in done.plan.flights),
            "cross_track_rms_m": float(np.sqrt(np.mean(cross**2))) if len(cross) else math.nan,
            "cross_track_p95_m": float(np.quantile(np.abs(cross), 0.95)) if len(cross) else math.nan,
            "cross_track_max_m": float(np.abs(cross).max()) if len(cross) else math.nan,
            "passes": len(done.plan.passes),
            "passes_flown": int((done.flown > 0.99).sum()),
            "passes_flown_share": [round(share, 4) for share in done.flown.tolist()],
        }
    return result


def _spread(numbers: Floats | Longs | NDArray[np.int32]) -> dict[str, float]:
    """Least, median and greatest."""
    if not len(numbers):
        return dict.fromkeys(("least", "median", "most"), math.nan)
    return {"least": float(numbers.min()), "median": float(np.median(numbers)), "most": float(numbers.max())}
