"""Make `demo.mcap`, the recording of `workbench demo`: same script, same libraries, same bytes.

It is the scenario `demo` (workbench/scenarios/demo.toml), written with JPEG images. A vehicle drives six tenths
of a figure eight over gravel and crosses its own way. Its camera looks straight down from 20.02 cm (0.0782 cm per
pixel) at 30 frames per second. Two things go wrong:

- frames 60 to 84: the exposure jumps up by 35 % and back again;
- frames 198 to 205: the image centre is over a steel grating, whose pattern repeats every 8 px, so that the
  correlation has many equal peaks; it is in view from frame 186 to frame 219.

The reference pose, the camera's height and its intrinsics are recorded beside the images, and in `/truth/faults`
the list of these two faults.

    python recordings/make_demo.py
"""

from pathlib import Path

from pipelines.simulation.mission import SimulatedMission
from workbench import scenarios
from workbench.writers import write

TARGET = Path(__file__).with_name("demo.mcap")
JPEG_QUALITY = 75


def demo_mission() -> SimulatedMission:
    """The mission that the recording shows."""
    return scenarios.mission(scenarios.load("demo"))


def main() -> None:
    """Write the recording."""
    mission = demo_mission()
    TARGET.unlink(missing_ok=True)
    write(mission, TARGET, quality=JPEG_QUALITY)
    print(f"{TARGET.name}: {len(mission.truth_poses)} frames, {TARGET.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
