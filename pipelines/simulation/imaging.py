"""What a camera on board sends: exposed frames, rendered when they are asked for.

Every picture is a function of the mission and its own number, so that random access gives the same bytes
as reading in order. The faults of the pictures themselves are acted on here; those of their way to the log
are `timing.schedule`'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.channels import Channel, Longs
from pipelines.simulation.faults import (
    DroppedFrames,
    DuplicateFrames,
    ExposureJump,
    Fault,
    ImageNoise,
    LateImages,
    LensDirt,
    MotionBlur,
    SwappedStamps,
    WrongCalibration,
    of_kind,
)
from pipelines.simulation.motion import Motion, Mount
from pipelines.simulation.render import behind_dirt, expose, noise_key_of, view
from pipelines.simulation.scene import Scene
from pipelines.simulation.timing import Schedule
from readers.streams import Camera, ImageError, ImageSample, StreamKind

Floats = NDArray[np.float64]

OF_IMAGES = (
    MotionBlur,
    ExposureJump,
    ImageNoise,
    LensDirt,
    DroppedFrames,
    DuplicateFrames,
    LateImages,
    SwappedStamps,
    WrongCalibration,
)
EXPOSURE_SAMPLES = 15


@dataclass(frozen=True, kw_only=True)
class CameraOnBoard:
    """A camera of a mission that starts at `start_ns`.

    Attributes:
        stream: name of its images.
        camera: what it is in truth.
        mount: where it sits and how it is held.
        motion: the motion of the vehicle that it sits on.
        scene: what there is to be seen.
        start_ns: time at which the mission starts.
        plan: when it takes its pictures, each the middle of its exposure, and the messages that carry them.
        rate_hz: pictures per second.
        exposure_s: how long the shutter is open, without a fault.
        readout_s: time from the first row to the last.
        noise_grey: standard deviation of the sensor's noise.
        vignetting: fall of brightness in the image corners, 0…1.
        seed: seed of noise and dirt.
        faults: what goes wrong in the mission; kinds that are not of the pictures do no harm here.
        name: name of the mission.
    """

    stream: str
    camera: Camera
    mount: Mount
    motion: Motion
    scene: Scene
    start_ns: int
    plan: Schedule
    rate_hz: float
    exposure_s: float = 0.0
    readout_s: float = 0.0
    noise_grey: float = 2.0
    vignetting: float = 0.0
    seed: int = 0
    faults: tuple[Fault, ...] = ()
    name: str = "simulated"

    @property
    def t_ns(self) -> Longs:
        """True times of the pictures in nanoseconds [n]."""
        return self.start_ns + np.rint(self.plan.t_s * 1e9).astype(np.int64)

    @cached_property
    def poses(self) -> Floats:
        """Where it is then, from above: x (m), y (m), heading of its u axis (rad, continuous) [n, 3]."""
        world_r_camera, position = self.mount.world_t_camera(self.motion.at(self.plan.t_s))
        heading = np.unwrap(np.arctan2(world_r_camera[:, 1, 0], world_r_camera[:, 0, 0]))
        return np.column_stack([position[:, :2], heading])

    @cached_property
    def heights_m(self) -> Floats:
        """Its height above z = 0 then [n]."""
        return np.asarray(self.mount.world_t_camera(self.motion.at(self.plan.t_s))[1][:, 2])

    def picture(self, k: int) -> NDArray[np.uint8]:
        """The picture taken at ``plan.t_s[k]``, uint8 [height, width].

        Raises:
            IndexError: there is no such picture.
        """
        if not 0 <= k < len(self.plan.t_s):
            raise IndexError(f"frame {k} of a mission of {len(self.plan.t_s)} frames")
        t_s = float(self.plan.t_s[k])
        now = tuple(fault for fault in self.faults if fault.holds(t_s))
        image = self._seen(t_s, now)
        for soiled in of_kind(now, LensDirt):
            image = behind_dirt(image, soiled.share, self.seed)
        jumps = of_kind(now, ExposureJump)
        return expose(
            image,
            noise_key=noise_key_of(self.seed, k),
            noise_grey=max((fault.noise_grey for fault in of_kind(now, ImageNoise)), default=self.noise_grey),
            gain=float(np.prod([jump.gain for jump in jumps])),
            offset_grey=float(sum(jump.offset_grey for jump in jumps)),
            vignetting=self.vignetting,
        )

    def _seen(self, t_s: float, now: tuple[Fault, ...]) -> NDArray[np.float32]:
        """What is seen while the shutter is open: the longest of its own exposure and those of the faults."""
        exposures = [(self.exposure_s, EXPOSURE_SAMPLES)]
        exposures += [(blur.exposure / self.rate_hz, blur.samples) for blur in of_kind(now, MotionBlur)]
        exposure_s, samples = max(exposures)
        return view(
            self.scene,
            self.camera,
            self.mount,
            self.motion,
            t_s,
            exposure_s=exposure_s,
            exposure_samples=samples,
            readout_s=self.readout_s,
        )

    def channel(self) -> Channel:
        """The stream of its images."""
        return Channel(
            stream=self.stream,
            kind=StreamKind.IMAGE,
            type="sensor_msgs/msg/Image",
            frame=self.camera.frame,
            number=self.plan.number,
            stamp_ns=self.plan.stamp_ns,
            received_ns=self.plan.received_ns,
            sample=self._image,
        )

    def _image(self, number: int, t_ns: int, received_ns: int) -> ImageSample:
        return ImageSample(
            stream=self.stream,
            t_ns=t_ns,
            received_ns=received_ns,
            encoding="mono8",
            payload=partial(self._bytes, number),
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            step_bytes=self.camera.width_px,
            source=self._source(number),
        )

    def _bytes(self, number: int) -> memoryview:
        try:
            return self.picture(number).data.cast("B")
        except ValueError as error:
            raise ImageError(f"{self._source(number)}: {error}") from error

    def _source(self, number: int) -> str:
        return f"{self.name} {self.stream} frame {number}"
