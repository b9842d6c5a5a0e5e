"""Images: every encoding that a log may hold, to grey levels or RGB.

Raw encodings have the names of ROS's `sensor_msgs/image_encodings`, with OpenCV's own type names
(``8UC1``, ``8UC3``, …; three and four channels in the order blue, green, red, alpha) beside them.
Compressed images are whatever OpenCV opens, named by their format (``jpeg``, ``png``, …).

Grey is 0.299 R + 0.587 G + 0.114 B. A JPEG is decoded straight to its own grey channel; of a YUV
image grey is the Y channel as stored. Colour from YUV follows BT.601 with Y from 16 to 235, as OpenCV
does it. Depth images hold distances, not grey levels: `decode_depth` reads them. The orientation that EXIF states
is not applied: pixels stay where the sensor had them.
Decoded arrays are read-only, because they may be a view of the stored bytes.
"""

from __future__ import annotations

import dataclasses
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from readers.streams import ImageError

if TYPE_CHECKING:
    from readers.streams import ImageSample

    Pixels = NDArray[np.uint8] | NDArray[np.uint16]

# A damaged image is an ImageError, not a line on stderr.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


@dataclass(frozen=True, slots=True)
class RawFormat:
    """How a raw encoding lies in memory and how OpenCV converts it (None: nothing to convert).

    `rows` is the number of stored rows over the number of image rows, times two (3 for NV12 and NV21, 6 for NV24).
    """

    bits: int
    channels: int
    to_grey: int | None
    to_rgb: int | None
    rows: int = 2


def _packed() -> dict[str, RawFormat]:
    """Encodings with the same number of bytes for each pixel, by name."""
    orders = {
        "rgb": (3, cv2.COLOR_RGB2GRAY, None),
        "bgr": (3, cv2.COLOR_BGR2GRAY, cv2.COLOR_BGR2RGB),
        "rgba": (4, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2RGB),
        "bgra": (4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2RGB),
        "mono": (1, None, cv2.COLOR_GRAY2RGB),
        # OpenCV names a mosaic by its second row, second and third pixel; ROS by its first four.
        "bayer_rggb": (1, cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2RGB),
        "bayer_bggr": (1, cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2RGB),
        "bayer_gbrg": (1, cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2RGB),
        "bayer_grbg": (1, cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2RGB),
    }
    formats = {f"{order}{bits}": RawFormat(bits, *orders[order]) for order in orders for bits in (8, 16)}
    for channels, order in ((1, "mono"), (3, "bgr"), (4, "bgra")):
        for bits in (8, 16):
            formats[f"{bits}uc{channels}"] = formats[f"{order}{bits}"]
    formats["8uc"], formats["16uc"] = formats["mono8"], formats["mono16"]
    return formats


_UYVY = RawFormat(8, 2, cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2RGB_UYVY)
_YUYV = RawFormat(8, 2, cv2.COLOR_YUV2GRAY_YUY2, cv2.COLOR_YUV2RGB_YUY2)

RAW_FORMATS: dict[str, RawFormat] = _packed() | {
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
    "yuy2": _YUYV,
    "nv12": RawFormat(8, 1, None, cv2.COLOR_YUV2RGB_NV12, rows=3),
    "nv21": RawFormat(8, 1, None, cv2.COLOR_YUV2RGB_NV21, rows=3),
    "nv24": RawFormat(8, 1, None, None, rows=6),
}
"""The raw encodings, by their names in lower case."""

COMPRESSED_FORMATS = ("jpeg", "png", "tiff", "bmp", "webp", "pnm", "jp2", "exr", "hdr", "sun", "avif")
"""The compressed formats (whether each can be decoded depends on how OpenCV was built)."""

DEPTH_HEADER = struct.Struct("<iff")
"""Before the picture of a compressedDepth image: its format, and the parameters A and B of 32FC1."""
MOST_PX = 1 << 27
"""Larger pictures are taken for damage, before anything of their size is allocated."""

_ALIASES = {"jpg": "jpeg", "tif": "tiff"} | dict.fromkeys(("pgm", "ppm", "pbm"), "pnm")


def decode_grey(sample: ImageSample) -> Pixels:
    """Decode to grey levels.

    Args:
        sample: a raw or compressed image.

    Returns:
        Read-only grey levels, shape [height, width], uint8, or uint16 for 16-bit images. A tightly
        packed ``mono8`` image is a view of the stored bytes.

    Raises:
        ImageError: the image is damaged or its encoding is not supported.
    """
    raw = RAW_FORMATS.get(sample.encoding.lower())
    if raw is None:
        return _finish(_decompress(sample, cv2.IMREAD_GRAYSCALE))
    pixels = _raw_pixels(sample, raw)
    if raw.rows > 2:
        pixels = pixels[: sample.height_px]
    return _finish(_convert(sample, pixels, raw.to_grey))


def decode_colour(sample: ImageSample) -> Pixels:
    """Decode to RGB.

    Args:
        sample: a raw or compressed image.

    Returns:
        Read-only RGB values, shape [height, width, 3], uint8, or uint16 for 16-bit images.

    Raises:
        ImageError: the image is damaged or its encoding is not supported.
    """
    raw = RAW_FORMATS.get(sample.encoding.lower())
    if raw is None:
        return _finish(cv2.cvtColor(_decompress(sample, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))
    pixels = _raw_pixels(sample, raw)
    return _finish(_nv24_rgb(pixels) if raw.rows == 6 else _convert(sample, pixels, raw.to_rgb))


def _nv24_rgb(planes: Pixels) -> Pixels:
    """RGB of Y and, below it, U and V in turn for every pixel [3 h, w]: BT.601 with Y from 16 to 235."""
    height, width = planes.shape[0] // 3, planes.shape[1]
    y = 1.164 * (planes[:height].astype(np.float32) - 16.0)
    u, v = np.moveaxis(planes[height:].reshape(height, width, 2).astype(np.float32) - 128.0, 2, 0)
    rgb = np.stack([y + 1.596 * v, y - 0.813 * v - 0.391 * u, y + 2.018 * u], axis=-1)
    return np.asarray(np.clip(np.rint(rgb), 0, 255), np.uint8)


def decode_depth(sample: ImageSample) -> NDArray[np.float32]:
    """Decode to distances.

    Args:
        sample: a raw image of 16-bit millimetres (``16UC1``, ``mono16``) or float metres (``32FC1``), a PNG of
            millimetres, or a ``compressedDepth`` image of either: 12 bytes of parameters before a PNG or RVL.

    Returns:
        Read-only metres, shape [height, width]; NaN where nothing was measured.

    Raises:
        ImageError: the image is damaged or holds no distances.
    """
    name = sample.encoding.lower()
    if is_depth(sample.encoding):
        return _finish_depth(_compressed_depth(sample))
    if name == "32fc1":
        return _finish_depth(_float_pixels(sample))
    grey = decode_grey(sample)
    if grey.dtype != np.uint16:
        raise _error(sample, "it holds no distances; known are 16UC1, 32FC1, compressedDepth and PNG of 16 bits")
    return _finish_depth(_metres(cast("NDArray[np.uint16]", grey)))


def is_depth(encoding: str) -> bool:
    """Whether an encoding is one of compressedDepth, such as ``16UC1; compressedDepth png``."""
    return "compresseddepth" in encoding.lower()


def _metres(millimetres: NDArray[np.uint16]) -> NDArray[np.float32]:
    depth = millimetres.astype(np.float32) * np.float32(0.001)
    depth[millimetres == 0] = np.nan
    return depth


def _float_pixels(sample: ImageSample) -> NDArray[np.float32]:
    """The pixels of a raw 32FC1 image [h, w]; zero and infinity are no distances."""
    whole = _stored_rows(sample, sample.width_px * 4, sample.height_px)
    pixels = whole.view(">f4" if sample.big_endian else "<f4").astype(np.float32)
    pixels[~(np.isfinite(pixels) & (pixels > 0))] = np.nan
    return pixels


def _compressed_depth(sample: ImageSample) -> NDArray[np.float32]:
    """Metres of a compressedDepth image: of ``32FC1`` A / (stored - B), parameters A and B before the picture."""
    data = memoryview(sample.data)
    if len(data) < DEPTH_HEADER.size + 8:
        raise _error(sample, f"it holds {len(data)} bytes, too few for its parameters and a picture")
    _, scale, shift = DEPTH_HEADER.unpack_from(data)
    stored = _depth_picture(sample, data[DEPTH_HEADER.size :])
    if not sample.encoding.lower().startswith("32fc1"):
        return _metres(stored)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(scale) / (stored.astype(np.float32) - np.float32(shift))
    depth[(stored == 0) | ~np.isfinite(depth)] = np.nan
    return np.asarray(depth, np.float32)


def _depth_picture(sample: ImageSample, packed: memoryview) -> NDArray[np.uint16]:
    """The picture behind the parameters [h, w]: a PNG, or columns, rows and RVL."""
    if bytes(packed[:4]) == b"\x89PNG":
        pixels = _decompress(dataclasses.replace(sample, encoding="png", payload=packed), cv2.IMREAD_UNCHANGED)
        if pixels.dtype != np.uint16 or pixels.ndim != 2:
            raise _error(sample, "its PNG is not of one channel of 16 bits")
        return cast("NDArray[np.uint16]", pixels)
    from readers.rvl import unpack

    width, height = struct.unpack_from("<ii", packed)
    if not (width > 0 and height > 0 and width * height <= MOST_PX):
        raise _error(sample, f"it claims a size of {width} x {height} px")
    try:
        return unpack(packed[8:], width * height).reshape(height, width)
    except ValueError as error:
        raise _error(sample, str(error)) from None


def _finish_depth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    depth.setflags(write=False)
    return depth


def image_header(data: bytes | memoryview) -> tuple[str, int, int]:
    """Name and size of a compressed image from its first bytes.

    Args:
        data: the beginning of the file; of a JPEG enough to hold all that stands before its size.

    Returns:
        The format (one of `COMPRESSED_FORMATS`, or ``""`` if unknown), width and height in px
        (0, 0 where these bytes do not tell).
    """
    head = bytes(data[:32])
    if head.startswith(b"\xff\xd8\xff"):
        return ("jpeg", *_jpeg_size(data))
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        size = struct.unpack_from(">II", head, 16) if head[12:16] == b"IHDR" and len(head) >= 24 else (0, 0)
        return ("png", *size)
    if head.startswith(b"BM"):
        size = struct.unpack_from("<ii", head, 18) if len(head) >= 26 else (0, 0)
        return ("bmp", abs(size[0]), abs(size[1]))
    return (_by_magic(head), 0, 0)


def _by_magic(head: bytes) -> str:
    """Format by its first 32 bytes, ``""`` if unknown."""
    magics = {
        b"II*\0": "tiff",
        b"MM\0*": "tiff",
        b"\0\0\0\x0cjP  ": "jp2",
        b"\xffO\xffQ": "jp2",
        b"v/1\x01": "exr",
        b"#?RADIANCE": "hdr",
        b"\x59\xa6\x6a\x95": "sun",
    }
    for magic, name in magics.items():
        if head.startswith(magic):
            return name
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "webp"
    if head[4:12] == b"ftypavif":
        return "avif"
    if head[:1] == b"P" and head[1:2] in b"1234567" and head[2:3] in (b" ", b"\t", b"\r", b"\n"):
        return "pnm"
    return ""


def _jpeg_size(data: bytes | memoryview) -> tuple[int, int]:
    """Width and height from the frame header of a JPEG, (0, 0) if `data` ends before it."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], data[at + 2] << 8 | data[at + 3]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return data[at + 7] << 8 | data[at + 8], data[at + 5] << 8 | data[at + 6]
        at += 1 if marker == 0xFF else 2 + length
    return 0, 0


def _raw_pixels(sample: ImageSample, raw: RawFormat) -> Pixels:
    """The stored pixels without padding and in this machine's byte order, [rows, width] or [rows, width, n]."""
    width, height = sample.width_px, sample.height_px
    rows = (height * raw.rows + 1) // 2
    stored = _stored_rows(sample, width * raw.channels * raw.bits // 8, rows)
    shape = (rows, width) if raw.channels == 1 else (rows, width, raw.channels)
    if raw.bits == 8:
        return stored.reshape(shape)
    order = ">u2" if sample.big_endian else "<u2"
    return stored.view(order).astype(np.uint16, copy=False).reshape(shape)


def check_stated(sample: ImageSample) -> None:
    """Refuse an image that cannot be decoded by what is stated of it; its data are not looked at.

    Raises:
        ImageError: its encoding is not known, it has no pixels, or its rows do not fit into its step.
    """
    name = sample.encoding.lower()
    if (raw := RAW_FORMATS.get(name)) is not None:
        _step(sample, sample.width_px * raw.channels * raw.bits // 8)
    elif name == "32fc1":
        _step(sample, sample.width_px * 4)
    elif not is_depth(name):
        _check_format(sample)


def _step(sample: ImageSample, row: int) -> int:
    """The bytes from one stored row to the next, of which a row takes `row`."""
    if sample.width_px <= 0 or sample.height_px <= 0:
        raise _error(sample, f"its size is {sample.width_px} x {sample.height_px} px")
    step = sample.step_bytes or row
    if step < row:
        raise _error(sample, f"a row of {sample.width_px} px takes {row} bytes, but its step is {step} bytes")
    return step


def _stored_rows(sample: ImageSample, row: int, rows: int) -> NDArray[np.uint8]:
    """The bytes of a raw image without padding [rows, row]."""
    step = _step(sample, row)
    data = sample.data
    if len(data) < rows * step:
        raise _error(sample, f"{rows} rows of {step} bytes need {rows * step} bytes, but it holds {len(data)}")
    return np.ascontiguousarray(np.frombuffer(data, np.uint8, rows * step).reshape(rows, step)[:, :row])


def _convert(sample: ImageSample, pixels: Pixels, code: int | None) -> Pixels:
    """Convert by one of OpenCV's colour codes, None for as it is."""
    if code is None:
        return pixels
    if "bayer" in sample.encoding.lower() and min(pixels.shape) < 3:
        raise _error(sample, "a Bayer mosaic below 3 x 3 px cannot be interpolated")
    try:
        converted: Pixels = cv2.cvtColor(pixels, code)
    except cv2.error:
        raise _error(sample, f"its size of {sample.width_px} x {sample.height_px} px does not suit it") from None
    return converted


def _decompress(sample: ImageSample, mode: int) -> Pixels:
    """Decode a compressed image, [height, width] or [height, width, 3] in the order B, G, R."""
    name = sample.encoding.lower()
    if is_depth(name) or name == "32fc1":
        raise _error(sample, "32FC1 and compressedDepth hold distances, not a picture; depth() reads them")
    _check_format(sample)
    data = sample.data
    if len(data) == 0:
        raise _error(sample, "it holds 0 bytes")
    if _cut_short(data):
        raise _error(sample, f"it is cut short, its {len(data)} bytes have no end mark")
    _, width, height = image_header(data)
    if width * height > MOST_PX:
        raise _error(sample, f"it claims a size of {width} x {height} px")
    flags = mode | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise _error(sample, f"OpenCV cannot decode its {len(data)} bytes")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise _error(sample, f"its pixels are {pixels.dtype}, neither 8 nor 16 bits")
    return cast("Pixels", pixels)


def _check_format(sample: ImageSample) -> None:
    name = sample.encoding.lower()
    if _ALIASES.get(name, name) not in COMPRESSED_FORMATS:
        known = ", ".join((*RAW_FORMATS, *COMPRESSED_FORMATS))
        raise _error(sample, f"this encoding is not known; known are {known}")


def _cut_short(data: bytes | memoryview) -> bool:
    """Whether a JPEG or PNG lacks its end; some versions of the decoders fill up with grey instead of failing."""
    if bytes(data[:3]) == b"\xff\xd8\xff":
        if bytes(data[-2:]) == b"\xff\xd9":
            return False
        whole = bytes(data)  # bytes may follow the end; a thumbnail's end stands before the last scan
        return whole.rfind(b"\xff\xd9") < whole.rfind(b"\xff\xda")
    if bytes(data[:4]) == b"\x89PNG":
        return b"IEND" not in bytes(data[-12:]) and bytes(data).rfind(b"IEND") < 0
    return False


def _finish(pixels: Pixels) -> Pixels:
    pixels.setflags(write=False)
    return pixels


def _error(sample: ImageSample, problem: str) -> ImageError:
    where = f" ({sample.source})" if sample.source else ""
    return ImageError(f"{sample.stream}{where}: image of encoding {sample.encoding!r}: {problem}")
