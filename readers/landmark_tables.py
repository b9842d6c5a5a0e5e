"""Recordings of landmarks without images: UTIAS MRCLAM folders and the tables of the UTIAS course (MATLAB)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from readers.folder_streams import Draft
from readers.folder_tables import Table, read_table
from readers.streams import (
    UNKNOWN_VEC3,
    Camera,
    Landmark,
    ReadOptions,
    RecordingError,
    array,
)

Floats = NDArray[np.float64]

NOT_SEEN = -1.0
BARCODES, SURVEY = "Barcodes.dat", "Landmark_Groundtruth.dat"
COURSE_SHAPES: dict[str, tuple[int | str, ...]] = {
    "t": (1, "K"),
    "v_vk_vk_i": (3, "K"),
    "w_vk_vk_i": (3, "K"),
    "theta_vk_i": (3, "K"),
    "r_i_vk_i": (3, "K"),
    "y_k_j": (4, "K", "J"),
    "rho_i_pj_i": (3, "J"),
    "C_c_v": (3, 3),
    "rho_v_c_v": (3, 1),
    "fu": (1, 1),
    "fv": (1, 1),
    "cu": (1, 1),
    "cv": (1, 1),
    "b": (1, 1),
}
"""Variables of the course's table by name, with their shapes for K moments and J landmarks."""


# ---------------------------------------------------------------------------------- MRCLAM


def mrclam(root: Path, options: ReadOptions) -> Draft | None:
    """UTIAS MRCLAM: of every robot the commanded velocities, ranges and bearings to landmarks, and its path if known.

    Measurements name barcodes; `Barcodes.dat` maps them to subjects, of which those in
    `Landmark_Groundtruth.dat` stand still and the others are robots. Bearings are counter-clockwise.
    """
    odometers = sorted(root.glob("Robot*_Odometry.dat"))
    if not odometers:
        return None
    draft = Draft(root, "UTIAS MRCLAM folder")
    subject_of = _subjects(draft, root / BARCODES)
    _survey(draft, root / SURVEY)
    for file in odometers:
        robot = file.name.partition("_")[0]
        _velocities(draft, robot.lower(), file)
        _sightings(draft, robot.lower(), root / f"{robot}_Measurement.dat", subject_of)
        _path(draft, robot.lower(), root / f"{robot}_Groundtruth.dat")
    return draft


def _subjects(draft: Draft, file: Path) -> dict[int, int]:
    """The subject that carries each barcode; empty, with a note, where the file is missing."""
    if not file.is_file():
        draft.note(f"{file.name} is missing: landmarks are known by their barcodes")
        return {}
    table = read_table(file)
    return {int(barcode): int(subject) for subject, barcode in _numbers(draft, table, 2, identities=2)}


def _survey(draft: Draft, file: Path) -> None:
    if not file.is_file():
        draft.note(f"{file.name} is missing: the landmarks' places are unknown")
        return
    for subject, x, y, sigma_x, sigma_y in _numbers(draft, read_table(file), 5, identities=1):
        draft.landmarks[int(subject)] = Landmark(
            position_m=array(x, y, np.nan), sigma_m=array(sigma_x, sigma_y, np.nan)
        )


def _velocities(draft: Draft, robot: str, file: Path) -> None:
    table = read_table(file)
    times, rows = table.timed(0, "s", [1, 2])
    draft.bad_rows(table)
    values = np.zeros((len(times), 6))
    values[:, 0], values[:, 5] = rows.T
    draft.odometry(f"{robot}/odometry", times, values, "MRCLAM odometry (as commanded)")


def _sightings(draft: Draft, robot: str, file: Path, subject_of: dict[int, int]) -> None:
    if not file.is_file():
        draft.note(f"{file.name} is missing: {robot} has no measurements")
        return
    table = read_table(file)
    times, rows = table.timed(0, "s", [1, 2, 3], identities=[1])
    draft.bad_rows(table)
    codes = rows[:, 0].astype(np.int64)
    known = np.array([not subject_of or int(code) in subject_of for code in codes], dtype=bool)
    if not known.all():
        draft.note(f"{file.name}: {int((~known).sum())} measurements of barcodes that {BARCODES} lacks are left out")
    ids = np.array([subject_of.get(int(code), int(code)) for code in codes[known]], dtype=np.int64)
    moving = int(np.isin(ids, list(draft.landmarks), invert=True).sum())
    if draft.landmarks and moving:
        draft.note(f"{file.name}: {moving} of {len(ids)} measurements are of other robots, which move")
    draft.sightings(f"{robot}/landmarks", times[known], ids, rows[known, 1:], "MRCLAM range and bearing")


def _path(draft: Draft, robot: str, file: Path) -> None:
    """The robot's true path where the folder has it."""
    if not file.is_file():
        return
    table = read_table(file)
    times, rows = table.timed(0, "s", [1, 2, 3])
    draft.bad_rows(table)
    half, zero = rows[:, 2] / 2, np.zeros(len(times))
    position = np.column_stack([rows[:, :2], zero])
    quat = np.column_stack([zero, zero, np.sin(half), np.cos(half)])
    draft.poses(f"{robot}/reference", times, position, quat, "MRCLAM ground truth", child=robot)


def _numbers(draft: Draft, table: Table, count: int, *, identities: int) -> list[list[float]]:
    """The rows of a table of numbers, the first of which are `identities`; those left out that hold less."""
    rows = []
    for line, cells in table.rows:
        try:
            rows.append([(table.identity if k < identities else table.number)(cells[k]) for k in range(count)])
        except (ValueError, IndexError) as error:
            table.bad.append((line, str(error)))
    draft.bad_rows(table)
    return rows


# --------------------------------------------------------------------- the UTIAS course's table


def landmark_table(root: Path, options: ReadOptions) -> Draft | None:
    """A folder with one MATLAB table of the UTIAS course on state estimation."""
    files = sorted(root.glob("*.mat"))
    return course_table(files[0]) if len(files) == 1 else None


def course_table(file: Path) -> Draft:
    """Tracks of landmarks in a stereo camera, velocities, poses and landmarks of the UTIAS course's `dataset3.mat`.

    The vehicle's frame v and the camera's frame c as in the table: `C_c_v` turns v into c, `rho_v_c_v` is the
    camera's place in v; theta_vk_i is the rotation vector of world_r_body.

    Raises:
        RecordingError: the file is no MATLAB 5 table, or lacks a variable of that layout.
    """
    values = _loaded(file)
    _check(file, values)
    draft = Draft(file, "UTIAS course table (MATLAB)")
    times = np.rint(values["t"].ravel() * 1e9).astype(np.int64)
    draft.note("times begin at 0: the table has no date")
    velocities = np.column_stack([values["v_vk_vk_i"].T, values["w_vk_vk_i"].T])
    draft.odometry("vehicle/odometry", times, velocities, "measured body velocities")
    quats = np.array([_quat(turn) for turn in values["theta_vk_i"].T])
    draft.poses("vehicle/reference", times, values["r_i_vk_i"].T.copy(), quats, "motion capture", child="vehicle")
    for name, first in (("camera/left", 0), ("camera/right", 2)):
        points = [_seen(values["y_k_j"][first : first + 2, k]) for k in range(len(times))]
        draft.tracks(f"{name}/tracks", times, points, "pixel tracks of landmarks")
        draft.cameras[f"{name}/tracks"] = _course_camera(values, name, float(values["b"].item()) if first else 0.0)
    for j, position in enumerate(values["rho_i_pj_i"].T):
        draft.landmarks[j] = Landmark(position_m=array(*position), sigma_m=UNKNOWN_VEC3)
    empty = int(np.all(values["y_k_j"][0] == NOT_SEEN, axis=1).sum())
    if empty:
        draft.note(f"{empty} of {len(times)} moments see no landmark")
    for name, unit in (("y_var", "px²"), ("v_var", "m²/s²"), ("w_var", "rad²/s²")):
        if name in values:
            draft.note(f"{name}, the variances that the table states: {values[name].ravel().tolist()} {unit}")
    return draft


def _loaded(file: Path) -> dict[str, Any]:
    import scipy.io

    try:
        return dict(scipy.io.loadmat(file))
    except NotImplementedError:
        problem, cure = "it is a MATLAB 7.3 table (HDF5)", "save it with -v7"
    except Exception as error:  # the library raises what it likes on a damaged file
        problem, cure = f"it cannot be read as a MATLAB 5 table ({error})", "check that the file is complete"
    raise RecordingError(file, problem, cure)


def _check(file: Path, values: dict[str, Any]) -> None:
    sizes = {"K": np.size(values.get("t", ())), "J": (0, *np.shape(values.get("rho_i_pj_i", ())))[-1]}
    for name, shape in COURSE_SHAPES.items():
        found = np.asarray(values.get(name, ()))
        if found.shape != tuple(sizes.get(str(n), n) for n in shape) or found.dtype.kind not in "iuf":
            known = ", ".join(sorted(k for k in values if not k.startswith("__"))) or "none"
            problem = f"a MATLAB table without the landmark tracks of the UTIAS course ({name} is missing or misshapen)"
            cure = f"its variables are {known}; convert it to a bag or MCAP file"
            raise RecordingError(file, problem, cure)
        if not np.all(np.isfinite(found)) or (name == "t" and not np.all((found >= 0) & (found < 2**33))):
            problem = f"its variable {name} holds a number that is not finite, or a time that is none"
            raise RecordingError(file, problem, "mend it in MATLAB and save it again")


def _seen(columns: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Ids and points (u, v) of the landmarks that are seen, of columns [2, N]."""
    ids = np.flatnonzero(np.all(columns != NOT_SEEN, axis=0))
    return ids.astype(np.int64), np.ascontiguousarray(columns[:, ids].T)


def _quat(turn: Floats) -> Floats:
    """Quaternion x, y, z, w [4] of a rotation vector [3]."""
    angle = float(np.linalg.norm(turn))
    return np.append(np.sinc(angle / (2 * np.pi)) / 2 * turn, np.cos(angle / 2))


def _course_camera(values: dict[str, Any], name: str, baseline_m: float) -> Camera:
    """The left or right camera of the rectified stereo pair; its size is not in the table."""
    fu, fv, cu, cv = (float(values[k].item()) for k in ("fu", "fv", "cu", "cv"))
    matrix = array([fu, 0, cu], [0, fv, cv], [0, 0, 1])
    turn = values["C_c_v"].T
    body_t_camera = np.eye(4)
    body_t_camera[:3, :3] = turn
    body_t_camera[:3, 3] = values["rho_v_c_v"].ravel() + turn @ np.array([baseline_m, 0, 0])
    return Camera(
        width_px=0,
        height_px=0,
        matrix=matrix,
        distortion_model="none",
        distortion=array(),
        rectification=array(*np.eye(3)),
        projection=array(*np.column_stack([matrix, [-fu * baseline_m, 0, 0]])),
        frame=name,
        body_t_camera=body_t_camera,
    )
