"""Footprints and coverage against a projecting camera; areas, exports and plans read back; the commands."""

import base64
import json
import math
import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import shapely
from recordings_dir import RECORDINGS
from shapely.geometry import box

from pipelines.lens import pinhole, project
from pipelines.patrol import footprint as feet
from pipelines.patrol.area import Area
from pipelines.patrol.coverage import Looks, coverage, forward_overlaps, gaps
from pipelines.patrol.flown import beside, flown_shares
from pipelines.patrol.lanes import Strip
from pipelines.patrol.place import Origin
from pipelines.patrol.plan import Plan, Task, snake
from pipelines.patrol.vehicle import Vehicle
from pipelines.simulation.motion import NADIR, rotations
from readers.streams import RecordingError
from workbench import rrd_reading
from workbench.cli import main
from workbench.patrol import areas, exports, saved
from workbench.patrol.colours import UNSEEN
from workbench.settings import SettingsError

HERE = Origin.of_degrees(30.17122333, -98.08999167, 265.0)
CAMERA = pinhole(320, 240, 300.0, distortion=(-0.08, 0.01))


def plan_of(origin: Origin = HERE, **changes: object) -> exports.Sheet:
    area = Area(box(0, 0, 120, 80).difference(box(90, 10, 110, 30)), (box(40, 30, 55, 45),), 3.0)
    task = Task(area, Strip(20.0, 10.0, 0.2), Vehicle(4.0), **changes)
    return exports.Sheet(snake(task), origin, 30.0, 5.0)


# --------------------------------------------------------------------------- footprints


def pose(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    angles = (rng.uniform(-3, 3, 1), rng.uniform(-0.4, 0.4, 1), rng.uniform(-0.4, 0.4, 1))
    return np.array([*rng.uniform(-20, 20, 2), rng.uniform(10, 30)]), rotations(*angles)[0]


def seen(points: np.ndarray, position: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of points [n, 2] on the ground z = 1."""
    away = np.column_stack([points, np.full(len(points), 1.0)]) - position
    return project(CAMERA, away @ turn @ NADIR)


def test_the_border_of_a_footprint_is_the_border_of_the_image() -> None:
    view = feet.View.of_camera(CAMERA, NADIR)
    for seed in range(5):
        position, turn = pose(seed)
        u, v = seen(view.footprint(position, turn, 1.0), position, turn).T + 0.5
        on_side = np.minimum(np.minimum(u, 320 - u), np.minimum(v, 240 - v))
        assert np.abs(on_side).max() < 1e-6


def test_the_sample_distance_is_the_root_of_a_pixels_area_on_the_ground() -> None:
    plain = pinhole(320, 240, 300.0)
    view = feet.View.of_camera(plain, NADIR)
    position, turn = pose(3)
    points = view.footprint(position, turn, 1.0)[::5] * 0.5 + view.footprint(position, turn, 1.0).mean(axis=0) * 0.5
    for point in points:
        step = 1e-4
        shifted = point + np.array([[0, 0], [step, 0], [0, step]])
        away = np.column_stack([shifted, np.full(3, 1.0)]) - position
        here, east, north = project(plain, away @ turn @ NADIR)
        area = step**2 / abs(np.linalg.det(np.array([east - here, north - here])))
        found = view.sample_distance(point[None], position, turn, 1.0)
        assert found[0] == pytest.approx(math.sqrt(area), rel=1e-4)


def test_heights_give_what_they_are_for() -> None:
    across, along = math.radians(60), math.radians(45)
    assert feet.swath(13.0, across) == pytest.approx(15.011, abs=1e-3)
    assert feet.height_for_swath(feet.swath(13.0, across), across) == pytest.approx(13.0)
    view = feet.View.of_angles(across, along, across_px=4000)
    height = feet.height_for_sample_distance(0.01, across, 4000)
    straight = view.sample_distance(np.zeros((1, 2)), np.array([0, 0, height]), np.eye(3))
    assert straight[0] == pytest.approx(0.01)
    for tilt in (0.0, 0.3, -0.3):
        view = feet.View.of_angles(across, along, tilt_rad=tilt)
        height = feet.height_for_range(50.0, across, along, tilt)
        corners = view.footprint(np.array([0, 0, height]), np.eye(3))
        assert np.hypot(np.hypot(*corners.T), height).max() == pytest.approx(50.0)
    with pytest.raises(ValueError, match="horizon"):
        feet.View.of_angles(across, along, tilt_rad=1.3).footprint(np.array([0, 0, 9.0]), np.eye(3))
    with pytest.raises(ValueError, match="above the ground"):
        view.footprint(np.array([0, 0, 1.0]), np.eye(3), 2.0)


def test_cells_are_counted_as_a_projecting_camera_sees_them() -> None:
    view = feet.View.of_camera(pinhole(320, 240, 300.0), NADIR)
    poses = [pose(seed) for seed in range(8)]
    looks = Looks(np.arange(8), np.array([p for p, _ in poses]), np.array([t for _, t in poses]))
    found = coverage(view, looks, cell_m=0.5, ground_m=1.0)
    middles = found.middles.reshape(-1, 2)
    count = np.zeros(len(middles), int)
    for position, turn in poses:
        away = np.column_stack([middles, np.ones(len(middles))]) - position
        u, v = project(pinhole(320, 240, 300.0), away @ turn @ NADIR).T
        count += (u > -0.5) & (u < 319.5) & (v > -0.5) & (v < 239.5)
    assert np.array_equal(count.reshape(found.count.shape), found.count)
    assert np.array_equal(np.isfinite(found.best_m), found.count > 0)
    assert found.seen.area == pytest.approx((found.count > 0).sum() * 0.25, rel=0.02)


def test_overlaps_and_gaps_of_squares_in_a_row() -> None:
    view = feet.View.of_angles(math.pi / 2, math.pi / 2, across_px=100)
    x = np.array([0.0, 5.0, 30.0])
    looks = Looks(np.arange(3), np.column_stack([x, np.zeros(3), np.full(3, 10.0)]), np.tile(np.eye(3), (3, 1, 1)))
    found = coverage(view, looks, cell_m=0.5)
    assert forward_overlaps(found).tolist() == pytest.approx([0.75, 0.0])
    assert found.best_m[found.count > 0].tolist() == pytest.approx([0.2] * int((found.count > 0).sum()))
    missed = gaps(found, box(-10, -10, 40, 12))
    assert [g.area for g in missed] == pytest.approx([100 + 100])
    assert (found.count == 2).sum() * 0.25 == pytest.approx(15 * 20)
    looks.position_m[1, 2] = -1.0
    assert list(coverage(view, looks, cell_m=0.5).without) == [1]
    with pytest.raises(ValueError, match="or more"):
        coverage(view, looks, cell_m=1e-3)


def test_cross_track_errors_have_a_side() -> None:
    plan = snake(Task(Area.square(30.0), Strip(30.0), direction_rad=0.0))
    start, stop = plan.passes[0]
    forward = np.sign(stop[0] - start[0])
    points = start + np.array([[10 * forward, 2.0 * forward], [20 * forward, -1.0 * forward]])
    found = beside(points, plan)
    assert found.cross_m.tolist() == pytest.approx([2.0, -1.0])
    assert found.sweeping.all()
    half = np.array([start, (start + stop) / 2])
    assert flown_shares(half, plan, 1.0).tolist() == pytest.approx([16 / 30], abs=0.01)


# ------------------------------------------------------------------------------- files


def metres(latitude_deg: list[float], longitude_deg: list[float]) -> np.ndarray:
    return HERE.enu(np.radians(latitude_deg), np.radians(longitude_deg))[:, :2]


def test_a_qgroundcontrol_plan_leads_to_the_same_places() -> None:
    sheet = plan_of()
    flight = sheet.plan.flights[0]
    values = json.loads(exports.qgroundcontrol(sheet, flight))
    assert values["fileType"] == "Plan"
    items = values["mission"]["items"]
    assert [item["doJumpId"] for item in items] == list(range(1, len(items) + 1))
    ways = [item["params"] for item in items if item["command"] == 16]
    assert metres([w[4] for w in ways], [w[5] for w in ways]) == pytest.approx(flight.points, abs=2e-3)
    assert {w[6] for w in ways} == {30.0}
    assert sum(item["command"] == 206 and item["params"][0] == 5.0 for item in items) == len(sheet.plan.passes)
    fence = values["geoFence"]["polygons"]
    assert [p["inclusion"] for p in fence] == [False, True]
    corners = np.array(fence[0]["polygon"])
    assert shapely.Polygon(metres(corners[:, 0], corners[:, 1])).equals_exact(
        box(40, 30, 55, 45).normalize(), 1e-3
    ) or (shapely.Polygon(metres(corners[:, 0], corners[:, 1])).symmetric_difference(box(40, 30, 55, 45)).area < 1e-2)


def test_mavlink_waypoints_lead_to_the_same_places() -> None:
    sheet = plan_of(vehicles=2)
    for _, flight in exports.flights(sheet.plan):
        head, *lines = exports.waypoints(sheet, flight).splitlines()
        assert head == "QGC WPL 110"
        rows = [line.split("\t") for line in lines]
        assert all(len(row) == 12 for row in rows)
        assert [int(row[0]) for row in rows] == list(range(len(rows)))
        assert rows[0][1:4] == ["1", "0", "16"]
        ways = [row for row in rows[1:] if row[3] == "16"]
        assert all(row[2] == "3" and float(row[10]) == 30.0 for row in ways)
        places = metres([float(row[8]) for row in ways], [float(row[9]) for row in ways])
        assert places == pytest.approx(flight.points, abs=2e-3)


@pytest.mark.parametrize("write", [exports.geojson, exports.kml])
def test_the_area_of_an_exported_plan_is_the_area(write, tmp_path: Path) -> None:
    sheet = plan_of()
    file = tmp_path / "plan"
    file.write_text(write(sheet), encoding="utf-8")
    back = areas.load(str(file), origin=HERE, clearance_m=3.0).area
    mine = sheet.plan.task.area
    assert back.polygon.symmetric_difference(mine.polygon).area < 1e-2
    assert back.no_go[0].symmetric_difference(mine.no_go[0]).area < 1e-2


def test_exported_lines_are_the_flights() -> None:
    sheet = plan_of()
    features = json.loads(exports.geojson(sheet))["features"]
    passes = [np.array(f["geometry"]["coordinates"]) for f in features if f["properties"]["role"] == "pass"]
    for line, mine in zip(passes, sheet.plan.passes, strict=True):
        assert metres(line[:, 1], line[:, 0]) == pytest.approx(mine, abs=2e-3)
    space = "{http://www.opengis.net/kml/2.2}"
    lines = ElementTree.fromstring(exports.kml(sheet)).iter(f"{space}LineString")
    (texts,) = [line.findtext(f"{space}coordinates").split() for line in lines]
    corners = np.array([[float(n) for n in text.split(",")] for text in texts])
    assert metres(corners[:, 1], corners[:, 0]) == pytest.approx(sheet.plan.flights[0].points, abs=2e-3)


def test_a_plan_comes_back_as_it_was(tmp_path: Path) -> None:
    sheet = plan_of(vehicles=2, home=(-5.0, -5.0))
    mine = saved.Saved(sheet.plan, HERE, 30.0, (1.0, math.nan))
    (tmp_path / saved.NAME).write_text(saved.to_text(mine), encoding="utf-8")
    back = saved.load(tmp_path)
    assert saved.to_text(back) == saved.to_text(mine)
    assert isinstance(back.plan, Plan)
    assert back.plan.task.area.polygon.equals(mine.plan.task.area.polygon)
    (tmp_path / saved.NAME).write_text('{"version": 9}')
    with pytest.raises(RecordingError, match="no plan of the workbench"):
        saved.load(tmp_path)


def test_areas_of_csv(tmp_path: Path) -> None:
    file = tmp_path / "field.csv"
    rows = "a,0,0 a,40,0 a,40,30 hole,10,1 hole,14,1 hole,14,2 no-go mast,20,5 no-go mast,25,5 no-go mast,25,9"
    file.write_text("ring,x,y\n" + re.sub(r"(?<=[0-9]) ", "\n", rows) + "\n")
    found = areas.load(str(file))
    assert found.origin is None
    assert found.area.polygon.area == pytest.approx(600 - 2)
    assert found.area.no_go[0].area == pytest.approx(10)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a,b\n1,2\n", "names no columns"),
        ('{"type": "FeatureCollection", "features": []}', "holds no polygon"),
        ("<kml><Placemark><Polygon/></Placemark>", "cannot be read as KML"),
        ("x,y\n0,0\n1,\n", "cannot be read as CSV"),
    ],
)
def test_a_file_that_is_no_area_says_so(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "area"
    file.write_text(text)
    with pytest.raises(RecordingError, match=problem):
        areas.load(str(file))


def test_swapped_degrees_are_noticed(tmp_path: Path) -> None:
    file = tmp_path / "area.csv"
    file.write_text("lat,lon\n-98.1,30.1\n-98.2,30.1\n-98.2,30.2\n")
    with pytest.raises(SettingsError, match="swapped"):
        areas.load(str(file))


# ---------------------------------------------------------------------------- commands


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_a_plan_is_flown_in_simulation_and_found_covered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "plan"
    fields = ("--height", 13, "--fov", "60x45", "--pixels", 640, "--origin", "61.45,23.86,100", "--speed", 5)
    assert run("patrol", "plan", "square:30", *fields, "-o", folder, "--json") == 0
    planned = json.loads(capsys.readouterr().out)
    assert planned["length_m"] == pytest.approx(30 + 15 + 30, abs=0.5)
    assert {Path(f).name for f in planned["files"]} == {
        "plan.json", "plan.toml", "plan.geojson", "plan.kml", "plan.plan", "plan.waypoints", "plan.rrd",
    }  # fmt: skip
    flight = ("patrol", "evaluate", folder / "plan.toml", "--plan", folder)
    assert run(*flight, "--poses", "/reference/pose", "--from-first", "-o", tmp_path / "out", "--json") == 0
    judged = json.loads(capsys.readouterr().out)
    assert judged["covered_share"] == pytest.approx(1, abs=1e-6)
    assert judged["against_plan"]["cross_track_max_m"] < 1e-5
    assert judged["against_plan"]["passes_flown"] == judged["against_plan"]["passes"] == planned["passes"]
    assert judged["sample_distance_m"]["median"] == pytest.approx(15.011 / 512, rel=1e-3)

    assert run(*flight, "--poses", "/gnss/fix", "-o", tmp_path / "gnss", "--json") == 0
    by_gnss = json.loads(capsys.readouterr().out)
    assert by_gnss["against_plan"]["cross_track_rms_m"] == pytest.approx(1.0, abs=0.4)
    assert by_gnss["covered_share"] > 0.95


def test_a_real_flight_is_mapped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = RECORDINGS / "drone_nadir_caliterra_a"
    words = ("patrol", "evaluate", photos, "--fov", "69.1x54.6", "--pixels", 4000)
    assert run(*words) == 2
    assert "--ground" in capsys.readouterr().err
    assert run(*words, "--ground", 280, "-o", tmp_path, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["footprints"] == found["pictures"] == 42
    assert found["height_m"]["least"] == pytest.approx(37.3, abs=0.1)
    assert found["forward_overlap"]["median"] == pytest.approx(0.76, abs=0.06)  # 0.76 by matching the pictures
    assert found["gaps"] == 0
    log = tmp_path / "coverage.rrd"
    overlap = rrd_reading.series(log, "/patrol/overlap", "Scalars:scalars")
    assert len(overlap.values) == 41
    assert np.median(overlap.values) == pytest.approx(found["forward_overlap"]["median"])
    entities = {chunk.entity_path for chunk in rrd_reading.chunks(log, "/world/**", is_static=None)}
    assert {"/world/coverage/times", "/world/coverage/resolution", "/world/flown", "/world/footprint"} <= entities
    shown = (tmp_path / "evaluation.html").read_text(encoding="utf-8")
    assert "http" not in re.sub(r"http-equiv", "", shown)  # it asks nothing of any network
    maps = [base64.b64decode(text) for text in re.findall(r"data:image/png;base64,([^\"]+)", shown)]
    times = cv2.imdecode(np.frombuffer(maps[0], np.uint8), cv2.IMREAD_COLOR)
    seen = float((times != np.array(UNSEEN[::-1])).any(axis=2).mean())
    rows, columns = times.shape[:2]
    size = re.search(r"(\d+) x (\d+) m;", shown)
    assert size is not None
    assert seen * int(size[1]) * int(size[2]) == pytest.approx(found["seen_m2"], rel=0.02)
    assert rows / columns == pytest.approx(int(size[2]) / int(size[1]), rel=0.01)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("plan", "square:100"), "one of --height, --swath, --gsd, --range"),
        (("plan", "square:x", "--height", 9), "no length in metres"),
        (("plan", "square", "--height", 9, "--fov", "200"), "between 0 and 180"),
        (("plan", "square", "--height", 9, "--overlap", 1), "from 0 to below 1"),
        (("plan", "square", "--height", 9, "--wind", "9,0"), "nothing can be flown upwind"),
        (("plan", "square", "--height", 9, "--wind", "9"), "two numbers with a comma"),
        (("plan", "square", "--gsd", 0.01), "--pixels"),
        (("plan", "square", "--height", 9, "--origin", "98,30"), "swapped"),
        (("plan", "square", "--height", 9, "--clearance", 60), "leave no place to fly"),
        (("plan", "square", "--height", 9, "--forward", 0.7), "69x55"),
        (("plan", "nothing.geojson", "--height", 9), "cannot be read"),
        (("evaluate", "sim:line", "--plan", "nowhere"), "the plan cannot be read"),
        (("evaluate", "sim:line", "--plan", "a", "--area", "b"), "give one of them"),
        (("footprint", "--height", 9, "--fov", "60x50", "--tilt", 70), "horizon"),
    ],
)
def test_errors_are_one_line_with_a_cure(
    words: tuple[object, ...], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("patrol", *words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert problem in said.err


def test_table_2_is_an_experiment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("reproduce", "paper-c-patrol", "-o", tmp_path, "--json") == 0
    values = json.loads(capsys.readouterr().out)
    upshots = {s["claim"]: s["upshot"] for s in values["statements"]}
    reached = [claim for claim, upshot in upshots.items() if upshot == "reached"]
    assert sum("those of Table 2" in claim for claim in reached) == 3
    assert upshots["spiral 1: the area is what is swept"] == "missed"
    assert "| snake | 805.0 (805) |" in (tmp_path / "report.md").read_text()
    assert (tmp_path / "pictures" / "paths.png").is_file()
