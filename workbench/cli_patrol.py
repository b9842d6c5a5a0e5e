"""The commands about patrols: footprint, plan, evaluate; and paper C's Table 2."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from workbench.terminal import examples, print_json, print_list, table

if TYPE_CHECKING:
    from pipelines.patrol.place import Origin

patrol = typer.Typer(
    help="Plan how a camera sweeps an area, and see whether a flight did.\n\n"
    "Lengths in metres, angles in degrees; x is east and y north where an area has a place on Earth.",
    rich_markup_mode=None,
)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Fov = Annotated[
    str, typer.Option("--fov", metavar="ACROSS[xALONG]", help="Camera's angles of view across and along the way.")
]
Pixels = Annotated[int | None, typer.Option("--pixels", metavar="N", help="Pixels of the image across the way.")]
Height = Annotated[float | None, typer.Option("--height", metavar="M", help="Height over ground.")]
Swath = Annotated[float | None, typer.Option("--swath", metavar="M", help="The height that gives this swath.")]
Gsd = Annotated[
    float | None, typer.Option("--gsd", metavar="M", help="The height that gives this much ground a pixel.")
]
Range = Annotated[
    float | None, typer.Option("--range", metavar="M", help="The height at which all seen is nearer than that.")
]
Place = Annotated[
    str | None, typer.Option("--origin", metavar="LAT,LON[,ALT]", help="Where (0, 0) lies; ALT of the ground.")
]


@patrol.command(
    short_help="What a camera sees of the ground from a height.",
    epilog=examples(
        "workbench patrol footprint --height 13 --fov 60",
        "workbench patrol footprint --gsd 0.02 --fov 69x55 --pixels 4000",
        "workbench patrol footprint --height 50 --fov 69x55 --tilt 20",
    ),
)
def footprint(
    fov: Fov,
    height: Height = None,
    swath: Swath = None,
    gsd: Gsd = None,
    reach: Range = None,
    pixels: Pixels = None,
    tilt: Annotated[float, typer.Option(metavar="DEG", help="Tilt of the camera from straight down, ahead.")] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Print the footprint of a camera on level ground, and the height that gives a swath, resolution or range."""
    import numpy as np

    from pipelines.patrol.footprint import View
    from workbench.patrol.planning import Optics
    from workbench.settings import SettingsError

    across, along = _angles(fov)
    optics = Optics(
        across_rad=across, along_rad=along, across_px=pixels, height_m=height, swath_m=swath, sample_distance_m=gsd,
        range_m=reach,
    )  # fmt: skip
    up = optics.height()
    try:
        view = View.of_angles(
            across, 1e-9 if math.isnan(along) else along, tilt_rad=math.radians(tilt), across_px=pixels or math.nan
        )
        corners = view.footprint(np.array([0.0, 0.0, up]), np.eye(3))
    except ValueError as error:
        raise SettingsError(f"--fov {fov} --tilt {tilt:g}: {error}") from error
    finest = view.sample_distance(corners, np.array([0.0, 0.0, up]), np.eye(3))
    near, far = float(np.ptp(corners[1:3, 1])), float(np.ptp(corners[[0, 3], 1]))
    values = {
        "height_m": up,
        "swath_m": near,
        "swath_far_m": far,
        "begins_m": float(corners[:, 0].min()),
        "ends_m": float(corners[:, 0].max()),
        "sample_distance_m": [float(finest.min()), float(finest.max())],
        "corners_m": corners.tolist(),
    }
    if as_json:
        print_json(values)
        return
    print(f"height  {up:.4g} m")
    print(f"swath   {near:.4g} m" + ("" if math.isclose(near, far) else f", {far:.4g} m at its far side"))
    if not math.isnan(along):
        print(f"along   {values['begins_m']:.4g} to {values['ends_m']:.4g} m ahead")
    if pixels:
        print(f"pixel   {100 * float(finest.min()):.3g} to {100 * float(finest.max()):.3g} cm on the ground")


@patrol.command(
    short_help="Plan the passes that sweep an area.",
    epilog=examples(
        "workbench patrol plan square:100 --fov 60 --height 13",
        "workbench patrol plan field.geojson --fov 69x55 --gsd 0.02 --pixels 4000 --overlap 0.3 --speed 8",
        "workbench patrol plan field.kml --no-go mast.kml --fov 60x45 --height 40 --clearance 5 --vehicles 2",
    ),
)
def plan(
    area: Annotated[str, typer.Argument(metavar="AREA", help="GeoJSON, KML or CSV file, or square:SIDE.")],
    fov: Fov = "60",
    height: Height = None,
    swath: Swath = None,
    gsd: Gsd = None,
    reach: Range = None,
    pixels: Pixels = None,
    no_go: Annotated[
        list[Path] | None, typer.Option("--no-go", metavar="FILE", help="Zones not to be flown over; repeatable.")
    ] = None,
    overlap: Annotated[float, typer.Option(metavar="SHARE", help="Overlap of neighbouring lanes.")] = 0.0,
    pictures_overlap: Annotated[
        float | None,
        typer.Option("--forward", metavar="SHARE", help="Overlap of pictures ahead: triggers by distance."),
    ] = None,
    clearance: Annotated[float, typer.Option(metavar="M", help="Distance kept from the border and from zones.")] = 0.0,
    direction: Annotated[
        float | None, typer.Option(metavar="DEG", help="Direction of the lanes from +x [the one with the fewest].")
    ] = None,
    speed: Annotated[float, typer.Option(metavar="M/S", help="Speed through the air.")] = 3.0,
    turn_time: Annotated[float, typer.Option("--turn-time", metavar="S", help="Time lost at each corner.")] = 0.0,
    turn_radius: Annotated[
        float, typer.Option("--turn-radius", metavar="M", help="Least radius of a turn; 0 turns on the spot.")
    ] = 0.0,
    run_out: Annotated[
        float, typer.Option("--run-out", metavar="M", help="How far turns in arcs may leave the area.")
    ] = 0.0,
    wind: Annotated[str, typer.Option(metavar="X,Y", help="Velocity of the air along x and y, m/s.")] = "0,0",
    vehicles: Annotated[int, typer.Option(metavar="N", help="How many fly at once.")] = 1,
    home: Annotated[str | None, typer.Option(metavar="X,Y", help="Where all take off and land, m.")] = None,
    power: Annotated[float | None, typer.Option(metavar="W", help="Power drawn in flight, for the energy.")] = None,
    origin: Place = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder [results/patrol-AREA].")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Plan lanes forth and back over an area, and passes along its border for what they leave out.

    The folder gets plan.json (for evaluate), plan.rrd (for view) and a scenario for simulate and replay; where the
    area has a place on Earth also plan.geojson, plan.kml, and QGroundControl's .plan and .waypoints of each flight.
    """
    from pipelines.patrol.vehicle import Vehicle
    from workbench.patrol import areas, planning
    from workbench.settings import SettingsError

    across, along = _angles(fov)
    optics = planning.Optics(
        across_rad=across, along_rad=along, across_px=pixels, height_m=height, swath_m=swath, sample_distance_m=gsd,
        range_m=reach,
    )  # fmt: skip
    if pictures_overlap is not None and math.isnan(along):
        raise SettingsError("--forward: needs the angle of view along the way, too: --fov 69x55")
    try:
        vehicle = Vehicle(
            speed_mps=speed,
            turn_s=turn_time,
            turn_radius_m=turn_radius,
            wind_mps=_pair(wind, "--wind"),
            power_w=math.nan if power is None else power,
        )
    except ValueError as error:
        raise SettingsError(str(error)) from error
    done = planning.plan(
        areas.load(area, no_go=no_go or (), origin=_origin(origin), clearance_m=clearance),
        optics,
        overlap=overlap,
        vehicle=vehicle,
        direction_rad=None if direction is None else math.radians(direction),
        vehicles=vehicles,
        home=None if home is None else _pair(home, "--home"),
        run_out_m=run_out,
        pictures_overlap=pictures_overlap,
        out=out or Path("results") / f"patrol-{Path(area.replace(':', '-')).stem}",
    )
    if as_json:
        print_json(planning.values(done))
        return
    print("\n".join(planning.sentences(done.saved, done.account, done.sample_distance_m)))
    print_list("files", [str(file) for file in done.files])


@patrol.command(
    short_help="What a flight has seen, and how it kept to its plan.",
    epilog=examples(
        "workbench patrol evaluate mission.bag --plan results/patrol-field",
        "workbench patrol evaluate photos/ --fov 69.1x54.6 --ground 265",
        "workbench patrol evaluate results/patrol-square-100/plan.toml --plan results/patrol-square-100 --from-first",
    ),
)
def evaluate(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Recording with poses or GNSS; sim:NAME or TOML.")],
    plan: Annotated[Path | None, typer.Option("--plan", metavar="DIR", help="What patrol plan wrote.")] = None,
    area: Annotated[str | None, typer.Option("--area", metavar="AREA", help="The area, for want of a plan.")] = None,
    fov: Annotated[
        str | None, typer.Option("--fov", metavar="ACROSSxALONG", help="Angles of view [the camera's, the plan's].")
    ] = None,
    pixels: Pixels = None,
    height: Height = None,
    ground: Annotated[
        float | None, typer.Option(metavar="M", help="Height of the ground; its altitude for GNSS.")
    ] = None,
    poses: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Pose, GNSS or odometry stream [the only].")
    ] = None,
    image: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Stream of the pictures, or none [the only].")
    ] = None,
    yaw: Annotated[float, typer.Option(metavar="DEG", help="Turn of the camera against the vehicle.")] = 0.0,
    cell: Annotated[float | None, typer.Option(metavar="M", help="Side of the map's cells [by the footprint].")] = None,
    from_first: Annotated[
        bool, typer.Option("--from-first", help="Move the flight so that it begins where the plan does.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder [results/NAME-patrol].")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Map what a recorded flight has seen: how often, how finely, and what not; and hold it against a plan.

    The folder gets coverage.rrd (for view), evaluation.html and evaluation.json.
    """
    from readers.streams import ReadOptions
    from workbench.opening import open_any
    from workbench.patrol import areas, evaluating, reporting, saved
    from workbench.settings import SettingsError

    if plan is not None and area is not None:
        raise SettingsError("--plan and --area: the plan has its area; give one of them")
    asked = evaluating.Asked(
        poses=poses,
        images=image,
        view_rad=None if fov is None else _both_angles(fov),
        across_px=math.nan if pixels is None else pixels,
        height_m=height,
        ground_m=ground,
        yaw_rad=math.radians(yaw),
        cell_m=cell,
        from_first=from_first,
    )
    with open_any(path, ReadOptions()) as recording:
        done = evaluating.evaluate(
            recording,
            asked,
            saved=None if plan is None else saved.load(plan),
            placed=None if area is None else areas.load(area),
        )
    name = str(path).removeprefix("sim:")
    folder = out or Path("results") / f"{Path(name).stem}-patrol"
    values = evaluating.values(done)
    files = reporting.write(done, values, folder)
    if as_json:
        print_json({**values, "files": [str(file) for file in files]})
        return
    print("\n".join(reporting.sentences(values)))
    print_list("files", [str(file) for file in files])


def table_2(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the results.")] = Path(
        "results/reproduce-paper-c-patrol"
    ),
    as_json: AsJson = False,
) -> None:
    """Recompute paper C's Table 2 of patrol methods, beside what a strip along those paths really sweeps.

    The folder then holds report.md with the tables and a picture, and the same values as JSON and CSV.
    """
    from workbench.reproduce import paper_c_patrol

    done = paper_c_patrol.reproduce(out)
    if as_json:
        print_json({**paper_c_patrol.values(done.results), "folder": str(done.folder)})
        return
    for heads, rows in paper_c_patrol.tables(done.results):
        print("\n".join(table(heads, rows, right=range(1, len(heads)))), end="\n\n")
    for statement in done.results.statements:
        print(f"{statement.upshot}: {statement.claim}\n    {statement.numbers}")
    print(f"\nreport  {done.file}")


# --------------------------------------------------------------------------------- helpers


def _angles(text: str) -> tuple[float, float]:
    """Angles of view across and along in rad, the second NaN where it is not given."""
    from workbench.settings import SettingsError

    across, cross, along = text.lower().partition("x")
    try:
        found = math.radians(float(across)), math.radians(float(along)) if cross else math.nan
    except ValueError:
        found = (math.nan, math.nan)
    if not all(0 < angle < math.pi for angle in (found if cross else found[:1])):
        raise SettingsError(
            f"--fov {text}: write degrees between 0 and 180, across and along: 69x55, or across only: 60"
        )
    return found


def _both_angles(text: str) -> tuple[float, float]:
    from workbench.settings import SettingsError

    found = _angles(text)
    if math.isnan(found[1]):
        raise SettingsError(f"--fov {text}: a footprint needs both angles of view, across and along: 69x55")
    return found


def _numbers(text: str, counts: Sequence[int], option: str, form: str) -> list[float]:
    from workbench.settings import SettingsError

    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) not in counts or not all(map(math.isfinite, found)):
        raise SettingsError(f"{option} {text}: write {form}")
    return found


def _pair(text: str, option: str) -> tuple[float, float]:
    first, second = _numbers(text, (2,), option, "two numbers with a comma, for example 2.5,-1")
    return first, second


def _origin(text: str | None) -> Origin | None:
    from pipelines.patrol.place import Origin
    from workbench.settings import SettingsError

    if text is None:
        return None
    try:
        return Origin.of_degrees(
            *_numbers(text, (2, 3), "--origin", "degrees, for example 30.17,-98.09 or 30.17,-98.09,265")
        )
    except ValueError as error:
        raise SettingsError(f"--origin {text}: {error}") from error


def register(app: typer.Typer, reproduce: typer.Typer) -> None:
    """Add these commands to the workbench's."""
    app.add_typer(patrol, name="patrol", short_help="Plan how a camera sweeps an area, and see whether a flight did.")
    reproduce.command(
        "paper-c-patrol",
        short_help="Patrol methods (paper C, Table 2).",
        epilog=examples("workbench reproduce paper-c-patrol"),
    )(table_2)
