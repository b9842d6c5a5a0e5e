"""The layouts of published image data sets: each function opens its own, or returns None for another one.

Positions come out in metres, angles in radians, quaternions as x, y, z, w, times in integer ns.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from readers.folder_streams import Draft, FolderRecording, file_header
from readers.folder_tables import Table, exact_ns, inside, read_table, unit_of_name
from readers.frame_times import (
    IMAGE_SUFFIXES,
    frame_number,
    frame_times,
    image_folders,
    image_groups,
    images_in,
    natural_key,
    ranks_of,
    shortened,
)
from readers.streams import Camera, Damage, FloatArray, ReadOptions, RecordingError, array, unknown_transform

BODY_FROM_CAMERA = array([0, 0, 1], [-1, 0, 0], [0, -1, 0])
"""Turns z forward, x right, y down into x forward, y left, z up."""

UE4_FROM_ENU = array([1, 0, 0], [0, -1, 0], [0, 0, 1])
"""Turns y right (left-handed) into y left, and back."""

_EUROC_MODELS = {"radial-tangential": "plumb_bob", "radtan": "plumb_bob", "equidistant": "equidistant"}
_NAN3, _NAN34 = array(*[[math.nan] * 3] * 3), array(*[[math.nan] * 4] * 3)
HEADER_LINES = 20
FAULTS_FILE, FAULTS_STREAM = "faults.json", "/truth/faults"
_TUM_COLUMNS = [1, 2, 3, 4, 5, 6, 7]


def open_layout(root: Path, options: ReadOptions) -> FolderRecording | None:
    """Open a folder by the first layout that knows it, None if none does."""
    from readers.landmark_tables import landmark_table, mrclam

    layouts = (euroc, tum_rgbd, kitti, surface_set, mocap_table, gnss_table, mrclam, plain_frames, landmark_table)
    for layout in layouts:
        draft = layout(root, options)
        if draft is not None:
            _add_faults(draft)
            _note_unused(draft, options)
            return draft.recording()
    return None


def _add_faults(draft: Draft) -> None:
    """The list of a simulated mission's faults, if there is one, at the time of the first sample."""
    file = draft.path / FAULTS_FILE
    if not file.is_file():
        return
    try:
        text = file.read_bytes().decode()
    except (OSError, UnicodeDecodeError) as error:
        draft.damage.append(Damage(what=f"the list of faults cannot be read ({error})", where=FAULTS_FILE))
        return
    first_ns = min((stream.info.first_ns for stream in draft.streams if stream.info.count), default=0)
    draft.texts(FAULTS_STREAM, [first_ns], [text], "list of faults")


def _note_unused(draft: Draft, options: ReadOptions) -> None:
    if options.rate_hz is not None and not draft.used_rate:
        draft.note(f"the given rate of {options.rate_hz:g} Hz was not used: the recording has times of its own")
    if options.times_file is not None and not draft.used_times_file:
        draft.note(f"the given times file {options.times_file.name} was not used: the recording has times of its own")


# ------------------------------------------------------------------------------- EuRoC ASL


def euroc(root: Path, options: ReadOptions) -> Draft | None:
    """EuRoC MAV data in ASL layout: cameras, IMUs and reference poses, each with its data.csv.

    Poses are `R_T_S`, of the body frame (the IMU's in EuRoC) in the reference frame, z up.
    """
    base = root / "mav0" if (root / "mav0").is_dir() else root
    sensors = sorted((p.parent for p in base.glob("*/data.csv")), key=natural_key)
    if not any(re.fullmatch(r"(cam|imu)\d*", s.name) for s in sensors):
        return None
    draft = Draft(root, "EuRoC ASL folder")
    for sensor in sensors:
        if re.fullmatch(r"cam\d*", sensor.name):
            _euroc_camera(draft, sensor)
        elif re.fullmatch(r"imu\d*", sensor.name):
            _euroc_imu(draft, sensor)
        elif re.match(r"state_groundtruth|vicon|mocap|leica|pose", sensor.name):
            _euroc_poses(draft, sensor)
        else:
            draft.note(f"{sensor.name}/data.csv is of no known kind and is left out")
    for file in sorted(root.glob("*groundtruth*.txt")):
        _tum_poses(draft, file, draft.free_name(file.stem), child="body")
    return draft


def _euroc_camera(draft: Draft, sensor: Path) -> None:
    table = read_table(sensor / "data.csv")
    files = _listed_images(draft, sensor.name, table, sensor / "data", unit_of_time(table, "ns"), "EuRoC image")
    unlisted = sum(file not in files for file in images_in(sensor / "data"))
    if unlisted:
        draft.note(f"{sensor.name}: {unlisted} images in data/ are not in data.csv and are left out")
    settings = _sensor_yaml(draft, sensor)
    camera = _euroc_intrinsics(settings)
    if camera is None:
        draft.note(f"{sensor.name}: no intrinsics that can be used in sensor.yaml")
        return
    draft.cameras[sensor.name] = camera
    transform = _matrix4(settings.get("T_BS"))
    if transform is not None:
        draft.note(f"{sensor.name}: body_T_cam (T_BS) is {transform.tolist()}")
        draft.cameras[sensor.name] = replace(camera, body_t_camera=transform)
    _check_size(draft, sensor.name, camera, files)


def _euroc_intrinsics(settings: dict[str, Any]) -> Camera | None:
    """The camera of a sensor.yaml, None unless it is a pinhole with four intrinsics."""
    try:
        fu, fv, cu, cv = (float(value) for value in settings["intrinsics"])
        width, height = (int(value) for value in settings["resolution"])
        coefficients = [float(value) for value in settings.get("distortion_coefficients") or []]
    except (KeyError, TypeError, ValueError):
        return None
    if settings.get("camera_model", "pinhole") != "pinhole":
        return None
    model = str(settings.get("distortion_model", "none"))
    return Camera(
        width_px=width,
        height_px=height,
        matrix=array([fu, 0, cu], [0, fv, cv], [0, 0, 1]),
        distortion_model=_EUROC_MODELS.get(model, model),
        distortion=array(*coefficients),
        rectification=_NAN3,
        projection=_NAN34,
    )


def _euroc_imu(draft: Draft, sensor: Path) -> None:
    table = read_table(sensor / "data.csv")
    named = table.columns(*(f"{q}_rs_s_{axis}" for q in "wa" for axis in "xyz"))
    if named is None:
        draft.note(f"{sensor.name}: columns taken by position as time, angular velocity, specific force")
    times, values = table.timed(0, unit_of_time(table, "ns"), named or [1, 2, 3, 4, 5, 6])
    draft.bad_rows(table)
    draft.imu(sensor.name, times, values, "EuRoC IMU")


def _euroc_poses(draft: Draft, sensor: Path) -> None:
    table = read_table(sensor / "data.csv")
    position = table.columns(*(f"p_rs_r_{c}" for c in "xyz")) or table.columns("px", "py", "pz")
    rotation = table.columns(*(f"q_rs_{c}" for c in "xyzw")) or table.columns("qx", "qy", "qz", "qw")
    if position is None or (rotation is None and len(table.header) > 4):
        draft.note(f"{sensor.name}: columns taken by position as time, x, y, z, qw, qx, qy, qz")
        position, rotation = [1, 2, 3], [5, 6, 7, 4]
    times, values = table.timed(0, unit_of_time(table, "ns"), position + (rotation or []))
    draft.bad_rows(table)
    quats = values[:, 3:] if rotation else np.full((len(times), 4), np.nan)
    draft.poses(sensor.name, times, values[:, :3], quats, "EuRoC pose")


def _sensor_yaml(draft: Draft, sensor: Path) -> dict[str, Any]:
    """What sensor.yaml says, empty if it is missing or cannot be parsed (which is noted)."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    path = sensor / "sensor.yaml"
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
        # OpenCV's first line `%YAML:1.0` is no YAML directive.
        parsed = YAML(typ="safe", pure=True).load(re.sub(r"\A%YAML:[^\n]*", "", text))
    except (OSError, YAMLError, ValueError) as error:
        draft.note(f"{sensor.name}: sensor.yaml cannot be read ({type(error).__name__})")
        return {}
    return parsed if isinstance(parsed, dict) else {}


def _matrix4(value: Any) -> FloatArray | None:
    try:
        return np.array(value["data"], float).reshape(4, 4)
    except (TypeError, KeyError, ValueError):
        return None


# ------------------------------------------------------------------------------- TUM RGB-D


def tum_rgbd(root: Path, options: ReadOptions) -> Draft | None:
    """TUM RGB-D: lists rgb.txt and depth.txt, groundtruth.txt; poses are of the camera's optical frame."""
    lists = [root / name for name in ("rgb.txt", "depth.txt") if (root / name).is_file()]
    if not lists:
        return None
    draft = Draft(root, "TUM RGB-D folder")
    for path in lists:
        table = read_table(path)
        _listed_images(draft, path.stem, table, root, "s", f"TUM {path.stem} image")
    if (truth := root / "groundtruth.txt").is_file():
        _tum_poses(draft, truth, "groundtruth", child="camera_optical")
    if (root / "accelerometer.txt").is_file():
        draft.note("accelerometer.txt is left out: it holds no angular velocity")
    return draft


def _tum_poses(draft: Draft, path: Path, name: str, *, child: str) -> None:
    """Poses in the TUM format: time in s, tx ty tz, qx qy qz qw."""
    table = read_table(path)
    times, values = table.timed(0, "s", _TUM_COLUMNS)
    draft.bad_rows(table)
    draft.poses(name, times, values[:, :3], values[:, 3:], "TUM trajectory", child=child)


def _listed_images(draft: Draft, name: str, table: Table, base: Path, unit: str, kind: str) -> set[Path]:
    """Add an image stream of rows of time and file name; returns the files that are listed."""
    times, files = [], []
    for line, cells in table.rows:
        try:
            t_ns, file = exact_ns(cells[0], unit), inside(base, " ".join(cells[1:]))
        except ValueError as error:
            table.bad.append((line, str(error)))
            continue
        times.append(t_ns)
        files.append(file)
    draft.bad_rows(table)
    draft.images(name, files, times, kind)
    return set(files)


# ---------------------------------------------------------------------------- KITTI odometry


def kitti(root: Path, options: ReadOptions) -> Draft | None:
    """KITTI odometry: image_0 … image_3, times.txt, calib.txt, poses.txt.

    A pose of the file is `C0_T_Ck`, camera 0's axes at the first frame against those at frame k (z
    forward, x right, y down). It comes out as `A (C0_T_Ck) Aᵀ` with A = `BODY_FROM_CAMERA`: a world with z
    up and x along the first view, a body with x forward.
    """
    folders = {p.name: images_in(p) for p in sorted(root.glob("image_[0-9]")) if images_in(p)}
    if not folders or not any((root / f"{name}.txt").is_file() for name in ("times", "calib", "poses")):
        return None
    draft = Draft(root, "KITTI odometry folder")
    ranks = {file: number for files in folders.values() for file, number in _kitti_numbers(files).items()}
    times = _kitti_times(draft, folders, ranks, options)
    for name, files in folders.items():
        timed = [file for file in files if ranks[file] in times]
        if len(timed) < len(files):
            draft.note(f"{name}: {len(files) - len(timed)} images have no row in times.txt and are left out")
        draft.images(name, timed, [times[ranks[file]] for file in timed], "KITTI image")
    used = {ranks[file] for files in folders.values() for file in files}
    if unused := len(times.keys() - used):
        draft.note(f"times.txt has {unused} rows without an image")
    _kitti_cameras(draft, root / "calib.txt", folders)
    _kitti_poses(draft, times, len(used))
    return draft


def _kitti_numbers(files: Sequence[Path]) -> dict[Path, int]:
    """Row of every image: the number in its name."""
    numbers = {file: frame_number(file) for file in files}
    if None in numbers.values() or len(set(numbers.values())) < len(files):
        return {file: row for row, file in enumerate(files)}
    return {file: number or 0 for file, number in numbers.items()}


def _kitti_times(
    draft: Draft, folders: dict[str, list[Path]], ranks: dict[Path, int], options: ReadOptions
) -> dict[int, int]:
    """Times in ns by row of times.txt (seconds), or as the user says where that file is missing."""
    path = draft.path / "times.txt"
    if not path.is_file():
        name, files = max(folders.items(), key=lambda item: len(item[1]))
        found = frame_times(draft, name, files, {file: row for row, file in enumerate(files)}, options)
        return {ranks[file]: t_ns for file, t_ns in found.items()}
    table = read_table(path)
    times = {}
    for row, (line, cells) in enumerate(table.rows):
        try:
            times[row] = exact_ns(cells[0], "s")
        except ValueError as error:
            table.bad.append((line, str(error)))
    draft.bad_rows(table)
    return times


def _kitti_cameras(draft: Draft, path: Path, folders: dict[str, list[Path]]) -> None:
    """Cameras from the rows of calib.txt, labelled ``P0:`` … or in that order; the images are rectified."""
    if not path.is_file():
        draft.note("calib.txt is missing: no intrinsics")
        return
    table, projections = read_table(path), {}
    labelled = any(cells[0].endswith(":") for _, cells in table.rows)
    for row, (line, cells) in enumerate(table.rows):
        label = cells[0].rstrip(":") if labelled else f"P{row}"
        if not re.fullmatch(r"P\d", label):
            continue
        try:
            projections[label[1:]] = _matrix34([table.number(cell) for cell in cells[labelled:]])
        except ValueError as error:
            table.bad.append((line, str(error)))
    draft.bad_rows(table)
    if not labelled:
        draft.note(f"calib.txt has no labels; its {len(projections)} rows are taken as P0, P1, … in that order")
    for name, files in folders.items():
        if (projection := projections.get(name[-1])) is not None:
            width, height = _size_of(files)
            draft.cameras[name] = replace(_rectified(projection, width, height), body_t_camera=_ahead(projection))
        else:
            draft.note(f"{name}: calib.txt has no P{name[-1]}, no intrinsics")


def _ahead(projection: FloatArray) -> FloatArray:
    """The transform of a rectified camera to the body: the place of camera 0, with the axes that the poses get.

    P = K [I | t], so that the camera stands at -K⁻¹ P e₄; unknown where K cannot be inverted.
    """
    if not np.isfinite(projection).all() or np.linalg.matrix_rank(projection[:, :3]) < 3:
        return unknown_transform()
    mounted = np.eye(4)
    mounted[:3, :3] = BODY_FROM_CAMERA
    mounted[:3, 3] = -BODY_FROM_CAMERA @ np.linalg.solve(projection[:, :3], projection[:, 3])
    return mounted


def _rectified(projection: FloatArray, width: int, height: int) -> Camera:
    return Camera(
        width_px=width,
        height_px=height,
        matrix=array(*projection[:, :3]),
        distortion_model="none",
        distortion=array(),
        rectification=_NAN3,
        projection=array(*projection),
    )


def _kitti_poses(draft: Draft, times: dict[int, int], images: int) -> None:
    path = draft.path / "poses.txt"
    if not path.is_file() and draft.path.parent.name == "sequences":
        path = draft.path.parent.parent / "poses" / f"{draft.path.name}.txt"
    if not path.is_file():
        draft.note("poses.txt is missing: no reference poses")
        return
    table = read_table(path)
    if len(table.rows) != images:
        draft.note(f"{path.name} has {len(table.rows)} poses for {images} images")
    stamps, poses = [], []
    for row, (line, cells) in enumerate(table.rows):
        try:
            pose = _kitti_pose([table.number(cell) for cell in cells])
        except ValueError as error:
            table.bad.append((line, str(error)))
            continue
        if row in times:
            stamps.append(times[row])
            poses.append(pose)
    if len(stamps) < len(table.rows) - len(table.bad):
        draft.note(f"{len(table.rows) - len(table.bad) - len(stamps)} poses have no time and are left out")
    draft.bad_rows(table)
    matrices = np.array(poses, float).reshape(len(poses), 3, 4)
    turn = BODY_FROM_CAMERA
    draft.poses("poses", stamps, matrices[:, :, 3] @ turn.T, quats_of(turn @ matrices[:, :, :3] @ turn.T), "KITTI pose")
    draft.note("poses: camera axes (z forward, x right, y down) were turned to x forward, y left, z up")


def _matrix34(numbers: list[float]) -> FloatArray:
    if len(numbers) != 12:
        raise ValueError(f"{len(numbers)} numbers instead of 12")
    return np.array(numbers).reshape(3, 4)


def _kitti_pose(numbers: list[float]) -> FloatArray:
    pose = _matrix34(numbers)
    if np.abs(pose[:, :3] @ pose[:, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(pose[:, :3]) < 0:
        raise ValueError("the first three columns are no rotation")
    return pose


def quats_of(rotations: FloatArray) -> FloatArray:
    """Quaternions x, y, z, w, shape [n, 4], of rotation matrices [n, 3, 3]."""
    from scipy.spatial.transform import Rotation

    if len(rotations) == 0:
        return np.empty((0, 4))
    quats: FloatArray = Rotation.from_matrix(rotations).as_quat()
    return quats


# --------------------------------------------------------------- surface images with one table


def surface_set(root: Path, options: ReadOptions) -> Draft | None:
    """Ground-surface images with file.csv: time, pose, distance to the surface, speed.

    Of E. Minaev, L. Zherdeva, V. Fursov (2022): time in s, x, y, z in cm and roll, pitch, yaw in degrees in
    UE4's left-handed axes (x forward, y right, z up; yaw clockwise from above, pitch up, roll to the
    right), distance in cm, speed in km/h. A pose R, t becomes F R F, F t with F = diag(1, -1, 1).
    """
    if not (files := images_in(root)):
        return None
    for path in _tables(root):
        columns = _surface_columns(read_table(path, lines_read=HEADER_LINES))
        if columns is not None:
            return _surface_draft(root, files, read_table(path), columns)
    return None


def _surface_columns(table: Table) -> list[int] | None:
    """Columns of time, x, y, z, roll, pitch, yaw, distance, speed (None if one of the first seven is missing)."""
    found = [table.column("time"), table.column("x"), table.column("y", but="yaw"), table.column("z")]
    found += [table.column("roll"), table.column("pitch"), table.column("yaw")]
    if None in found:
        return None
    found += [table.column("dist", "height"), table.column("speed", "velocity")]
    return [-1 if column is None else column for column in found]


def _surface_draft(root: Path, files: list[Path], table: Table, columns: list[int]) -> Draft:
    draft = Draft(root, "surface image set with one table")
    present = [column for column in columns if column >= 0]
    rows = {line: row for row, (line, _) in enumerate(table.rows)}
    total = len(table.rows)
    times, values = table.timed(columns[0], "s", present[1:])
    bad = {line for line, _ in table.bad}
    draft.bad_rows(table)
    time_of = dict(zip([row for line, row in rows.items() if line not in bad], times.tolist(), strict=True))
    numbers = _surface_numbers(draft, files, total, table.path.name)
    timed = [file for file in files if numbers[file] in time_of]
    if not timed:
        raise _no_times(table)
    if len(timed) < len(files):
        left = [file.name for file in files if numbers[file] not in time_of]
        draft.note(f"{len(left)} images without a row are left out ({shortened(left)})")
    draft.images("images", timed, [time_of[numbers[file]] for file in timed], "surface image")
    rotations = ue4_rotations(np.radians(values[:, 3:6]))
    draft.poses("reference", times, values[:, :3] / 100 @ UE4_FROM_ENU, quats_of(rotations), "UE4 pose")
    rest = 6
    if columns[7] >= 0:
        draft.ranges("height", times, values[:, rest] / 100, "distance to the surface")
        rest += 1
    if columns[8] >= 0:
        draft.scalars("speed_mps", times, values[:, rest] / 3.6, "speed")
    draft.note(f"{table.path.name}: cm, degrees and km/h were turned to SI, UE4's axes to x forward, y left, z up")
    return draft


def _surface_numbers(draft: Draft, files: list[Path], rows: int, table: str) -> dict[Path, int]:
    """Row of every image: its number if these count from 0 or 1, else its place."""
    numbers = [frame_number(file) for file in files]
    known = [number for number in numbers if number is not None]
    first = min(known, default=0)
    if len(files) != rows:
        draft.note(f"{table} has {rows} rows for {len(files)} images")
    if len(set(known)) == len(files) and first in (0, 1) and max(known) - first < max(rows, len(files)):
        return {file: number - first for file, number in zip(files, known, strict=True)}
    if len(files) != rows:
        draft.note("the numbers in the file names do not tell the rows: images and rows are paired in order")
    return {file: place for place, file in enumerate(files)}


def ue4_rotations(angles: FloatArray) -> NDArray[np.float64]:
    """Rotations `world_T_body` [n, 3, 3] (REP 103) of UE4's roll, pitch, yaw in rad [n, 3].

    UE4's pitch is up and its yaw clockwise: R = Rz(-yaw) Ry(-pitch) Rx(roll).
    """
    from scipy.spatial.transform import Rotation

    if len(angles) == 0:
        return np.empty((0, 3, 3))
    rotations: FloatArray = Rotation.from_euler("ZYX", angles[:, ::-1] * [-1, -1, 1]).as_matrix()
    return rotations


# ----------------------------------------------------------------- images with a table beside


def mocap_table(root: Path, options: ReadOptions) -> Draft | None:
    """Images beside a table of motion capture whose column ``frame`` names the image of each row.

    The time of an image is that of the first row that carries its number. Poses come out as stored.
    """
    for path in _tables(root):
        table = read_table(path, lines_read=HEADER_LINES)
        position = table.columns("x", "y", "z")
        rotation = table.columns("qx", "qy", "qz")
        time, frame = table.column("time", "t_"), table.column("frame", "image")
        if time is not None and frame is not None and position and rotation:
            return _mocap_draft(root, read_table(path), time, frame, position + rotation)
    return None


def _mocap_draft(root: Path, table: Table, time: int, frame: int, columns: list[int]) -> Draft | None:
    qw = table.column("qw")
    stamps, values = table.timed(time, unit_of_time(table, "s", time), [frame, *columns, *([] if qw is None else [qw])])
    first_seen: dict[int, int] = {}
    for t_ns, number in zip(stamps.tolist(), values[:, 0].tolist(), strict=True):
        first_seen.setdefault(int(number), t_ns)
    folder = _best_folder(root, lambda file: frame_number(file) in first_seen)
    if folder is None:
        return None
    draft = Draft(root, "image folder with a motion-capture table")
    draft.bad_rows(table)
    name = table.path.name
    files = images_in(folder)
    timed = [file for file in files if frame_number(file) in first_seen]
    draft.note(f"images: time of the first row of {name} that carries the number in the file name")
    _note_left_out(draft, files, timed, name)
    times = [first_seen[frame_number(file) or 0] for file in timed]
    unseen = len(first_seen.keys() - {frame_number(file) for file in timed} - {0})
    if unseen:
        draft.note(f"{name} names {unseen} frames of which there is no image")
    draft.images("images", timed, times, _kind_of(timed))
    quats = values[:, 4:] if qw is not None else _with_qw(draft, values[:, 4:7])
    draft.poses("mocap", stamps, values[:, 1:4], quats, "motion capture")
    draft.note("mocap: world and body axes are as stored")
    _note_other_folders(draft, folder)
    return draft


def _with_qw(draft: Draft, vector: FloatArray) -> FloatArray:
    """Quaternions from their vector parts [n, 3]: qw = sqrt(1 - |q|²)."""
    rest = 1 - np.sum(vector**2, axis=1)
    draft.note("mocap: qw is not stored; it is taken as sqrt(1 - qx² - qy² - qz²)")
    if over := int(np.sum(rest < 0)):
        draft.note(f"mocap: {over} quaternions are longer than 1 without qw; theirs is taken as 0")
    return np.column_stack([vector, np.sqrt(np.maximum(rest, 0))])


def gnss_table(root: Path, options: ReadOptions) -> Draft | None:
    """Photos beside a table of file, time, latitude and longitude in degrees, altitude in m."""
    for path in _tables(root):
        table = read_table(path, lines_read=HEADER_LINES)
        name, time = table.column("file", "image", "name"), table.column("exif_time", "time", "date")
        place = table.columns("lat", "lon", "alt")
        if name is not None and time is not None and place:
            return _gnss_draft(root, read_table(path), name, time, place)
    return None


def _gnss_draft(root: Path, table: Table, name: int, time: int, place: list[int]) -> Draft | None:
    table.bad += [(line, "too few columns") for line, cells in table.rows if len(cells) <= name]
    table.rows = [(line, cells) for line, cells in table.rows if len(cells) > name]
    listed = {cells[name] for _, cells in table.rows}
    folder = _best_folder(root, lambda file: file.name in listed)
    if folder is None:
        return None
    draft = Draft(root, "image folder with a GNSS table")
    stamps, values = table.timed(time, unit_of_time(table, "s", time), place)
    bad = {line for line, _ in table.bad}
    names = [cells[name] for line, cells in table.rows if line not in bad]
    draft.bad_rows(table)
    time_of = dict(zip(names, stamps.tolist(), strict=True))
    files = images_in(folder)
    timed = [file for file in files if file.name in time_of]
    if not timed:
        raise _no_times(table)
    draft.note(f"images: times from {table.path.name} (taken as UTC where they state no zone)")
    _note_left_out(draft, files, timed, table.path.name)
    draft.images("images", timed, [time_of[file.name] for file in timed], _kind_of(timed))
    draft.gnss("gps", stamps, np.column_stack([np.radians(values[:, :2]), values[:, 2]]), "GNSS fix")
    _note_missing(draft, folder, [n for n in names if n not in {f.name for f in files}])
    _note_other_folders(draft, folder)
    return draft


def _no_times(table: Table) -> RecordingError:
    why = f": line {table.bad[0][0]}: {table.bad[0][1]}" if table.bad else ""
    return RecordingError(table.path, f"gives no image a time{why}", "mend the table, or move it away and give a rate")


def _note_left_out(draft: Draft, files: Sequence[Path], timed: Sequence[Path], table: str) -> None:
    used = set(timed)
    left = [file.name for file in files if file not in used]
    if left:
        draft.note(f"{len(left)} images without a row in {table} are left out ({shortened(left)})")


def _note_missing(draft: Draft, folder: Path, names: list[str]) -> None:
    if names:
        draft.damage.append(Damage(what=f"{len(names)} images are missing ({shortened(names)})", where=folder.name))


def _note_other_folders(draft: Draft, used: Path) -> None:
    others = [name for name in image_folders(draft.path) if draft.path / name != used]
    if others:
        draft.note(f"other folders with images are left out ({shortened(others)}); open each by itself")


def _best_folder(root: Path, belongs: Any) -> Path | None:
    """The folder with the most images of which `belongs` is true: ``images``, the root, or one in it."""
    folders = [root / "images", root, *(root / name for name in image_folders(root))]
    counts = [sum(1 for file in images_in(folder) if belongs(file)) for folder in folders]
    best = max(counts)
    return folders[counts.index(best)] if best else None


# ----------------------------------------------------------------------------- plain frames


def plain_frames(root: Path, options: ReadOptions) -> Draft | None:
    """Images without a layout: one stream for each folder or family of names."""
    groups = image_groups(root)
    if not groups:
        return None
    draft = Draft(root, "image folder")
    ranks = ranks_of(groups)
    moment_of: dict[int, int] = {}
    for name, files in groups.items():
        times = frame_times(draft, name, files, ranks, options)
        timed = [file for file in files if file in times]
        draft.images(name, timed, [times[file] for file in timed], _kind_of(timed))
        moment_of.update({ranks[file]: t_ns for file, t_ns in times.items()})
    if images_in(root):
        _note_other_folders(draft, root)
    for path in sorted((*root.glob("pose*.txt"), *root.glob("groundtruth*.txt"), *root.glob("trajectory*.txt"))):
        _plain_poses(draft, path, moment_of)
    return draft


def _plain_poses(draft: Draft, path: Path, moment_of: dict[int, int]) -> None:
    """Poses of seven columns (one for each frame) or of eight (TUM format)."""
    table = read_table(path)
    widths = {len(cells) for _, cells in table.rows}
    if widths == {8}:
        _tum_poses(draft, path, draft.free_name(path.stem), child="camera_optical")
    elif widths == {7}:
        _poses_by_frame(draft, table, moment_of)
    else:
        draft.note(f"{path.name} holds neither 7 nor 8 numbers a row and is left out")


def _poses_by_frame(draft: Draft, table: Table, moment_of: dict[int, int]) -> None:
    stream, stamps, poses = draft.free_name(table.path.stem), [], []
    for row, (line, cells) in enumerate(table.rows):
        try:
            pose = [table.number(cell) for cell in cells]
        except ValueError as error:
            table.bad.append((line, str(error)))
            continue
        if row in moment_of:
            stamps.append(moment_of[row])
            poses.append(pose)
    draft.bad_rows(table)
    values = np.array(poses, float).reshape(len(poses), 7)
    draft.poses(stream, stamps, values[:, :3], values[:, 3:], "pose of each frame", child="camera_optical")
    draft.note(f"{table.path.name} has no times: row k is the pose of frame k, taken as x y z qx qy qz qw")
    if len(table.rows) != len(moment_of):
        draft.note(f"{table.path.name} has {len(table.rows)} poses for {len(moment_of)} frames")


# ------------------------------------------------------------------------------ small helpers


def unit_of_time(table: Table, default: str, column: int = 0) -> str:
    """The unit that the header states for that column, else `default`."""
    stated = unit_of_name(table.header[column]) if column < len(table.header) else None
    return stated or default


def _tables(root: Path) -> list[Path]:
    return sorted((p for p in root.iterdir() if p.suffix.lower() == ".csv" and p.is_file()), key=natural_key)


def _kind_of(files: Sequence[Path]) -> str:
    """``PNG files``, ``JPG and PNG files``."""
    kinds = sorted({file.suffix[1:].upper() for file in files if file.suffix.lower() in IMAGE_SUFFIXES})
    return f"{' and '.join(kinds)} files"


def _size_of(files: Sequence[Path]) -> tuple[int, int]:
    """Size of the first image whose header can be read, (0, 0) if there is none."""
    for file in files:
        try:
            return file_header(file)[1:]
        except (OSError, ValueError):
            continue
    return 0, 0


def _check_size(draft: Draft, name: str, camera: Camera, files: set[Path]) -> None:
    width, height = _size_of(sorted(files))
    if width and (width, height) != (camera.width_px, camera.height_px):
        draft.note(
            f"{name}: the calibration is for {camera.width_px} x {camera.height_px} px, "
            f"the images are {width} x {height} px"
        )


def refuse(root: Path) -> RecordingError:
    """Why a folder is no recording, and what to give instead."""
    names = sorted(p.name for p in root.iterdir() if not p.name.startswith("."))
    tables = [name for name in names if name.lower().endswith((".dat", ".mat"))]
    logs = [name for name in names if name.lower().endswith((".bag", ".mcap", ".db3", ".mp4", ".avi", ".mov", ".mkv"))]
    folders = [name for name in names if (root / name).is_dir()]
    if not names:
        return RecordingError(root, "the folder is empty", "give the folder or file of a recording")
    if logs:
        return RecordingError(root, f"a folder of {len(logs)} recordings, not one", f"give one: {shortened(logs, 4)}")
    if tables:
        return RecordingError(
            root,
            f"no images: its .dat or .mat tables ({shortened(tables, 4)}) are data of range or landmark measurements, "
            "no image folder of a known layout and no bag",
            "give a folder of images, a bag, an MCAP file or a video",
        )
    cure = f"give one of the folders in it: {shortened(folders, 6)}" if folders else "give a folder that holds images"
    return RecordingError(root, "no images, and no bag or MCAP file of a known layout", cure)
