"""Make `demo.mcap`, the recording of `workbench demo`: same script, same libraries, same bytes.

A vehicle drives six tenths of a figure eight over gravel and crosses its own way. Its camera looks
straight down from 20.02 cm (0.0782 cm per pixel) at 30 frames per second. Two things go wrong:

- frames 60 to 84: the exposure jumps up by 35 % and back again;
- frames 198 to 205: the image centre is over a steel grating, whose pattern repeats every 8 px, so that the
  correlation has many equal peaks; it comes into view ten frames earlier and leaves it ten later.

The reference pose, the camera's height and its intrinsics are recorded beside the images.

    python recordings/make_demo.py
"""

from pathlib import Path

import numpy as np

from pipelines.simulation.mission import ExposureJump, RepetitivePatch, SimulatedMission, nadir_camera
from pipelines.simulation.render import Patch
from pipelines.simulation.surfaces import gravel, tiles
from pipelines.simulation.trajectories import drive, figure_eight
from workbench.writers import write_mcap

TARGET = Path(__file__).with_name("demo.mcap")
FRAMES, RATE_HZ, SPEED_MPS = 300, 30.0, 0.42
SIDE_PX = (320, 240)
JPEG_QUALITY = 75
SEED = 20


def demo_mission() -> SimulatedMission:
    """The mission that the recording shows."""
    rng = np.random.default_rng(SEED)
    poses = drive(figure_eight(1.20, 0.38), FRAMES, speed_mps=SPEED_MPS, rate_hz=RATE_HZ, ramp_frames=20, rng=rng)
    ground = gravel(640, rng)
    grating = Patch(tiles(8, rng, joint_px=2, joint_grey=100), 0.50, 0.60, -0.70, -0.02)
    return SimulatedMission(
        ground,
        poses,
        camera=nadir_camera(*SIDE_PX),
        rate_hz=RATE_HZ,
        noise_grey=1.0,
        seed=SEED,
        faults=[ExposureJump(60, 85, 1.35), RepetitivePatch.over(poses, grating)],
        name="demo",
    )


def main() -> None:
    """Write the recording."""
    mission = demo_mission()
    TARGET.unlink(missing_ok=True)
    write_mcap(mission, TARGET, quality=JPEG_QUALITY)
    print(f"{TARGET.name}: {len(mission.truth_poses)} frames, {TARGET.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
