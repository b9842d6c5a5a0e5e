"""What a camera on board sends: exposed frames, rendered when they are asked for, and its calibration.

Every picture is a function of the mission and its own number, so that random access gives the same bytes
as reading in order. The faults of the images are acted on here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, Protocol

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from pipelines.simulation.channels import Channel, Longs, rng_of
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
from pipelines.simulation.render import Patch, expose, noise_key_of, radiance
from pipelines.simulation.surfaces import Surface
from readers.streams import Camera, CameraInfo, ImageSample, StreamKind

Floats = NDArray[np.float64]
Grey = NDArray[np.float32]

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
DIRT_GREY, DIRT_CONTRAST, DIRT_SIGMA_PX = 90.0, 35.0, 1.5


class View(Protocol):
    """What a camera sees: noise-free grey levels float32 [height, width], seen for `exposure_s` about `t_s`."""

    def __call__(self, t_s: float, *, exposure_s: float, samples: int) -> Grey:
        """The mean of `samples` pictures spread over the exposure; one picture where it is zero."""
        ...


class Messages(NamedTuple):
    """Which picture each message carries, its stamp, and when it was received, each int64 [m]."""

    number: Longs
    stamp_ns: Longs
    received_ns: Longs


def pinhole(width_px: int, height_px: int, focal_px: float, *, frame: str = "camera") -> Camera:
    """A camera without distortion, its principal point in the middle of the image."""
    u0, v0 = (width_px - 1) / 2, (height_px - 1) / 2
    matrix = np.array([[focal_px, 0, u0], [0, focal_px, v0], [0, 0, 1.0]])
    return Camera(
        width_px=width_px,
        height_px=height_px,
        matrix=matrix,
        distortion_model="plumb_bob",
        distortion=np.zeros(5),
        rectification=np.eye(3),
        projection=np.column_stack([matrix, np.zeros(3)]),
        frame=frame,
    )


@dataclass(frozen=True, kw_only=True)
class CameraOnBoard:
    """A camera of a mission that starts at `start_ns`.

    Attributes:
        stream: name of its images; its calibration comes under `info_stream`.
        camera: what it is in truth; what it is said to be is `sent_camera`.
        mount: where it sits and how it is held.
        motion: the motion of the vehicle that it sits on.
        rate_hz: pictures per second.
        t_s: times of its pictures [n], each the middle of the exposure.
        view: what it sees.
        exposure_s: how long the shutter is open, without a fault.
        noise_grey: standard deviation of the sensor's noise.
        vignetting: fall of brightness in the image corners, 0…1.
        seed: seed of noise and dirt.
        faults: what goes wrong in the mission; kinds that are not of the images do no harm here.
    """

    stream: str
    info_stream: str
    camera: Camera
    mount: Mount
    motion: Motion
    rate_hz: float
    t_s: Floats
    start_ns: int
    view: View
    exposure_s: float = 0.0
    exposure_samples: int = 15
    noise_grey: float = 2.0
    vignetting: float = 0.0
    seed: int = 0
    faults: tuple[Fault, ...] = ()
    name: str = "simulated"

    # ---- pictures

    def picture(self, k: int) -> NDArray[np.uint8]:
        """The picture taken at ``t_s[k]``, uint8 [height, width].

        Raises:
            IndexError: there is no such picture.
        """
        if not 0 <= k < len(self.t_s):
            raise IndexError(f"frame {k} of a mission of {len(self.t_s)} frames")
        t_s = float(self.t_s[k])
        now = tuple(fault for fault in self.faults if fault.holds(t_s))
        jumps = of_kind(now, ExposureJump)
        return expose(
            self._soiled(self._seen(t_s, of_kind(now, MotionBlur)), of_kind(now, LensDirt)),
            noise_key=noise_key_of(self.seed, k),
            noise_grey=max((fault.noise_grey for fault in of_kind(now, ImageNoise)), default=self.noise_grey),
            gain=float(np.prod([jump.gain for jump in jumps])),
            offset_grey=float(sum(jump.offset_grey for jump in jumps)),
            vignetting=self.vignetting,
        )

    def shown(self, k: int) -> int:
        """The picture that is sent at ``t_s[k]``: another one while duplicates are sent."""
        duplicates = [fault for fault in of_kind(self.faults, DuplicateFrames) if fault.holds(float(self.t_s[k]))]
        return min((self._last_before(fault.start_s) for fault in duplicates), default=k)

    def sent(self, k: int) -> bool:
        """Whether a picture is sent at ``t_s[k]``."""
        return not any(fault.holds(float(self.t_s[k])) for fault in of_kind(self.faults, DroppedFrames))

    def sent_camera(self, t_s: float) -> Camera:
        """The calibration that is sent at a time."""
        camera = self.camera
        for fault in of_kind(self.faults, WrongCalibration):
            if fault.holds(t_s):
                camera = miscalibrated(camera, fault)
        return camera

    def _last_before(self, t_s: float) -> int:
        return max(0, int(np.searchsorted(self.t_s, t_s)) - 1)

    def _seen(self, t_s: float, blurs: Sequence[MotionBlur]) -> Grey:
        if not blurs:
            return self.view(t_s, exposure_s=self.exposure_s, samples=self.exposure_samples)
        exposure, samples = max((blur.exposure, blur.samples) for blur in blurs)
        return self.view(t_s, exposure_s=exposure / self.rate_hz, samples=samples)

    def _soiled(self, image: Grey, dirt: Sequence[LensDirt]) -> Grey:
        for fault in dirt:
            share = np.float32(fault.share)
            image = image + share * (self._dirt - image)
        return image

    @cached_property
    def _dirt(self) -> Grey:
        """The fixed pattern on the lens, as coarse as pebbles and as strong as their contrast."""
        shape = (self.camera.height_px, self.camera.width_px)
        rng = rng_of(self.seed, self.stream, "dirt")
        pattern = scipy.ndimage.gaussian_filter(rng.standard_normal(shape), DIRT_SIGMA_PX)
        return np.asarray(DIRT_GREY + DIRT_CONTRAST * pattern / pattern.std(), dtype=np.float32)

    # ---- messages

    @property
    def t_ns(self) -> Longs:
        """Times of the pictures in nanoseconds [n]."""
        return self.start_ns + np.rint(self.t_s * 1e9).astype(np.int64)

    def messages(self) -> Messages:
        """One message a picture, received at once, as far as no fault changes that."""
        numbers = np.arange(len(self.t_s))
        return with_faults(Messages(numbers, self.t_ns, self.t_ns), self)

    def image_channel(self, messages: Messages | None = None) -> Channel:
        """The stream of images; `messages` where the transport is not perfect."""
        number, stamp_ns, received_ns = self.messages() if messages is None else messages
        return Channel(
            stream=self.stream,
            kind=StreamKind.IMAGE,
            type="sensor_msgs/msg/Image",
            frame=self.camera.frame,
            number=number,
            stamp_ns=stamp_ns,
            received_ns=received_ns,
            sample=self._image,
        )

    def info_channel(self) -> Channel:
        """The stream of calibrations, one with every picture."""
        return Channel(
            stream=self.info_stream,
            kind=StreamKind.CAMERA,
            type="sensor_msgs/msg/CameraInfo",
            frame=self.camera.frame,
            number=np.arange(len(self.t_s)),
            stamp_ns=self.t_ns,
            received_ns=self.t_ns,
            sample=self._info,
        )

    def _image(self, number: int, t_ns: int, received_ns: int) -> ImageSample:
        return ImageSample(
            stream=self.stream,
            t_ns=t_ns,
            received_ns=received_ns,
            encoding="mono8",
            payload=partial(_bytes, self.picture, number),
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            step_bytes=self.camera.width_px,
            source=f"{self.name} {self.stream} frame {number}",
        )

    def _info(self, number: int, t_ns: int, received_ns: int) -> CameraInfo:
        camera = self.sent_camera(float(self.t_s[number]))
        return CameraInfo(stream=self.info_stream, t_ns=t_ns, received_ns=received_ns, camera=camera)


def _bytes(picture: Callable[[int], NDArray[np.uint8]], number: int) -> memoryview:
    return picture(number).data.cast("B")


def miscalibrated(camera: Camera, fault: WrongCalibration) -> Camera:
    """The camera with a wrong focal length and centre, as the fault says."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= fault.focal_factor
    matrix[:2, 2] += fault.centre_px
    return replace(camera, matrix=matrix, projection=np.column_stack([matrix, np.zeros(3)]))


def with_faults(messages: Messages, camera: CameraOnBoard) -> Messages:
    """Messages of a camera's pictures after its faults: dropped, duplicate, late images and swapped stamps."""
    sent = np.array([camera.sent(int(k)) for k in messages.number], dtype=bool)
    number, stamp_ns, received_ns = (column[sent] for column in messages)
    t_s = camera.t_s[number]
    for late in of_kind(camera.faults, LateImages):
        delay = np.where((late.start_s <= t_s) & (t_s < late.stop_s), round(late.latency_s * 1e9), 0)
        stamp_ns, received_ns = stamp_ns + delay, received_ns + delay
    for swap in of_kind(camera.faults, SwappedStamps):
        held = np.flatnonzero((swap.start_s <= t_s) & (t_s < swap.stop_s))
        stamp_ns = stamp_ns.copy()
        pairs = held[: len(held) // 2 * 2].reshape(-1, 2)
        stamp_ns[pairs] = stamp_ns[pairs[:, ::-1]]
    shown = np.array([camera.shown(int(k)) for k in number], dtype=np.int64)
    order = np.argsort(received_ns, kind="stable")
    return Messages(shown[order], stamp_ns[order], received_ns[order])


def ground_view(surface: Surface, patches: Sequence[Patch], camera: Camera, mount: Mount, motion: Motion) -> View:
    """What a camera without distortion sees of the ground z = 0."""
    inverse, shape = np.linalg.inv(camera.matrix), (camera.height_px, camera.width_px)

    def view(t_s: float, *, exposure_s: float, samples: int) -> Grey:
        at = t_s + exposure_s * ((np.arange(samples) + 0.5) / samples - 0.5) if exposure_s else np.array([t_s])
        total = np.zeros(shape, dtype=np.float32)
        for rotation, (x, y, z) in zip(*mount.world_t_camera(motion.at(at)), strict=True):
            if not z > 0:
                raise ValueError(f"camera height {z} m at {t_s} s: it must be above the ground")
            world_h_pixel = np.array([[z, 0, -x], [0, z, -y], [0, 0, -1.0]]) @ rotation @ inverse
            total += radiance(surface, world_h_pixel, shape, patches)
        return total / np.float32(len(at))

    return view
