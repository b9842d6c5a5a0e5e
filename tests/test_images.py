"""Every encoding against a truth that is computed here, without OpenCV's colour conversion."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from readers.images import COMPRESSED_FORMATS, RAW_FORMATS, image_header
from readers.streams import ImageError, ImageSample

RNG = np.random.default_rng(7)
H, W = 6, 8


def sample(encoding: str, data: bytes, **fields: object) -> ImageSample:
    values = {"width_px": W, "height_px": H, "source": "frame 7"} | fields
    return ImageSample(stream="cam", t_ns=0, received_ns=0, encoding=encoding, payload=data, **values)


def stored(pixels: NDArray[np.generic], *, step: int = 0, big: bool = False) -> bytes:
    """The bytes of an image, each row filled up with junk to `step` bytes."""
    order = pixels.dtype.newbyteorder(">" if big else "<")
    rows = [row.astype(order).tobytes() for row in pixels]
    return b"".join(row + b"\xa5" * max(step - len(row), 0) for row in rows)


def grey_of(rgb: NDArray[np.generic]) -> NDArray[np.generic]:
    """0.299 R + 0.587 G + 0.114 B in 15-bit fixed point, rounded."""
    weighted = rgb.astype(np.int64) @ np.array([9798, 19235, 3735])
    return ((weighted + (1 << 14)) >> 15).astype(rgb.dtype)


def random(bits: int, *shape: int) -> NDArray[np.generic]:
    return RNG.integers(0, 1 << bits, shape, dtype=np.uint8 if bits == 8 else np.uint16)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize(
    ("order", "channels"),
    [("rgb{}", "rgb"), ("bgr{}", "bgr"), ("rgba{}", "rgba"), ("bgra{}", "bgra"), ("{}UC3", "bgr"), ("{}UC4", "bgra")],
)
def test_colour_orders(order: str, channels: str, pad: int, big: bool, bits: int) -> None:
    planes = {c: random(bits, H, W) for c in "rgba"}
    pixels = np.stack([planes[c] for c in channels], axis=-1)
    step = pixels[0].nbytes + pad
    image = sample(order.format(bits), stored(pixels, step=step, big=big), step_bytes=step, big_endian=big)
    rgb = np.stack([planes[c] for c in "rgb"], axis=-1)
    np.testing.assert_array_equal(image.colour(), rgb)
    assert image.colour().dtype == rgb.dtype
    if bits == 8:
        np.testing.assert_array_equal(image.grey(), grey_of(rgb))
    else:
        np.testing.assert_allclose(image.grey().astype(float), rgb @ np.array([0.299, 0.587, 0.114]), atol=2.5)
    assert image.grey().dtype == rgb.dtype


@pytest.mark.parametrize("encoding", ["mono8", "8UC1", "mono16", "16UC1"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("pad", [0, 3])
def test_mono(encoding: str, big: bool, pad: int) -> None:
    bits = 16 if "16" in encoding else 8
    pixels = random(bits, H, W)
    step = pixels[0].nbytes + pad
    image = sample(encoding, stored(pixels, step=step, big=big), step_bytes=step, big_endian=big)
    np.testing.assert_array_equal(image.grey(), pixels)
    np.testing.assert_array_equal(image.colour(), np.stack([pixels] * 3, axis=-1))
    assert image.grey().dtype == pixels.dtype
    assert image.grey().flags.c_contiguous
    assert not image.grey().flags.writeable


def test_tight_mono8_is_a_view_of_the_stored_bytes() -> None:
    data = bytes(range(H * W))
    image = sample("mono8", data)
    assert np.shares_memory(image.grey(), np.frombuffer(data, np.uint8))
    view = sample("mono8", memoryview(data))
    assert np.shares_memory(view.grey(), np.frombuffer(data, np.uint8))


def test_step_may_be_left_out_and_the_payload_may_be_a_function() -> None:
    pixels = random(8, H, W)
    image = ImageSample(
        stream="cam", t_ns=0, received_ns=0, encoding="mono8", payload=pixels.tobytes, width_px=W, height_px=H
    )
    np.testing.assert_array_equal(image.grey(), pixels)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer(pattern: str, bits: int) -> None:
    """A scene of one colour per half: away from the seam the mosaic's truth is that colour."""
    scale = 1 if bits == 8 else 257
    truth = np.zeros((16, 32, 3), np.uint8 if bits == 8 else np.uint16)
    truth[:, :16], truth[:, 16:] = np.array([200, 90, 10]) * scale, np.array([30, 120, 250]) * scale
    mosaic = np.zeros(truth.shape[:2], truth.dtype)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = truth[row::2, column::2, "rgb".index(colour)]
    image = sample(f"bayer_{pattern}{bits}", stored(mosaic), width_px=32, height_px=16)
    sides = np.r_[0:14, 18:32]
    np.testing.assert_array_equal(image.colour()[:, sides], truth[:, sides])
    error = image.grey()[:, sides].astype(int) - grey_of(truth[:, sides]).astype(int)
    assert np.abs(error).max() <= 1
    assert image.colour().dtype == image.grey().dtype == truth.dtype


def test_big_endian_bayer() -> None:
    mosaic = np.full((4, 4), 0x1234, np.uint16)
    image = sample("bayer_rggb16", stored(mosaic, big=True), width_px=4, height_px=4, big_endian=True)
    np.testing.assert_array_equal(image.grey(), mosaic)


def bt601(y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8]) -> NDArray[np.float64]:
    """RGB of BT.601 with Y from 16 to 235, all arrays [h, w]."""
    luma, blue, red = 1.164 * (y.astype(float) - 16), u.astype(float) - 128, v.astype(float) - 128
    rgb = np.stack([luma + 1.596 * red, luma - 0.813 * red - 0.391 * blue, luma + 2.018 * blue], axis=-1)
    return np.clip(rgb, 0, 255)


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
@pytest.mark.parametrize("pad", [0, 7])
def test_yuv422(encoding: str, pad: int) -> None:
    y = RNG.integers(16, 236, (H, W), dtype=np.uint8)
    u, v = (RNG.integers(90, 166, (H, W // 2), dtype=np.uint8) for _ in "uv")
    chroma = np.empty_like(y)
    chroma[:, 0::2], chroma[:, 1::2] = u, v
    pixels = np.stack([chroma, y] if encoding in ("yuv422", "uyvy") else [y, chroma], axis=-1)
    step = 2 * W + pad
    image = sample(encoding, stored(pixels, step=step), step_bytes=step)
    np.testing.assert_array_equal(image.grey(), y)
    expected = bt601(y, np.repeat(u, 2, axis=1), np.repeat(v, 2, axis=1))
    np.testing.assert_allclose(image.colour().astype(float), expected, atol=1.5)


@pytest.mark.parametrize("pad", [0, 3])
def test_semi_planar_with_chroma_of_every_pixel(pad: int) -> None:
    y = RNG.integers(16, 236, (H, W), dtype=np.uint8)
    u, v = (RNG.integers(90, 166, (H, W), dtype=np.uint8) for _ in "uv")
    chroma = np.stack([u, v], axis=-1).reshape(2 * H, W)
    image = sample("NV24", stored(np.concatenate([y, chroma]), step=W + pad), step_bytes=W + pad)
    np.testing.assert_array_equal(image.grey(), y)
    np.testing.assert_allclose(image.colour().astype(float), bt601(y, u, v), atol=1.5)


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
@pytest.mark.parametrize("pad", [0, 4])
def test_semi_planar(encoding: str, pad: int) -> None:
    y = RNG.integers(16, 236, (H, W), dtype=np.uint8)
    u, v = (RNG.integers(90, 166, (H // 2, W // 2), dtype=np.uint8) for _ in "uv")
    chroma = np.empty((H // 2, W), np.uint8)
    chroma[:, 0::2], chroma[:, 1::2] = (u, v) if encoding == "nv12" else (v, u)
    step = W + pad
    image = sample(encoding, stored(np.concatenate([y, chroma]), step=step), step_bytes=step)
    np.testing.assert_array_equal(image.grey(), y)
    full = [np.repeat(np.repeat(c, 2, axis=0), 2, axis=1) for c in (u, v)]
    np.testing.assert_allclose(image.colour().astype(float), bt601(y, *full), atol=1.5)


@pytest.mark.parametrize("extension", [".png", ".bmp", ".tiff", ".pgm", ".webp"])
def test_lossless_compressed_grey(extension: str) -> None:
    pixels = random(8, 16, 16)
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if extension == ".webp" else []
    data = cv2.imencode(extension, pixels, options)[1].tobytes()
    name, width, height = image_header(data)
    assert name == {".pgm": "pnm"}.get(extension, extension[1:])
    assert (width, height) in ((16, 16), (0, 0))
    grey = sample(name, data).grey()
    assert np.abs(grey.astype(int) - pixels.astype(int)).max() <= (1 if extension == ".webp" else 0)


def test_sixteen_bit_png_keeps_its_depth() -> None:
    pixels = random(16, H, W)
    image = sample("png", cv2.imencode(".png", pixels)[1].tobytes())
    np.testing.assert_array_equal(image.grey(), pixels)
    np.testing.assert_array_equal(image.colour(), np.stack([pixels] * 3, axis=-1))


def test_colour_png() -> None:
    rgb = random(8, H, W, 3)
    image = sample("png", cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
    np.testing.assert_array_equal(image.colour(), rgb)
    np.testing.assert_allclose(image.grey().astype(float), rgb @ np.array([0.299, 0.587, 0.114]), atol=1.01)


def jpeg(height: int = 48, width: int = 64) -> bytes:
    ramp = np.linspace(0, 255, width, dtype=np.uint8)
    grey = np.repeat(ramp[None], height, axis=0)
    return bytes(cv2.imencode(".jpg", cv2.merge([grey, grey, grey]), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())


def test_jpeg_to_grey_and_to_colour() -> None:
    image = sample("jpeg", jpeg())
    truth = np.repeat(np.linspace(0, 255, 64, dtype=np.uint8)[None], 48, axis=0).astype(int)
    assert np.abs(image.grey().astype(int) - truth).max() <= 4
    assert np.abs(image.colour().astype(int) - truth[..., None]).max() <= 4
    assert image.media_type == "image/jpeg"


def with_exif_orientation(data: bytes, orientation: int) -> bytes:
    tiff = b"II*\0\x08\0\0\0" + b"\x01\0" + b"\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + bytes(4)
    body = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:]


def test_exif_orientation_is_not_applied() -> None:
    turned = with_exif_orientation(jpeg(), 6)
    assert sample("jpeg", turned).grey().shape == (48, 64)
    assert sample("jpeg", turned).colour().shape == (48, 64, 3)
    assert image_header(turned) == ("jpeg", 64, 48)


def test_header_of_jpeg_and_png_needs_only_the_beginning() -> None:
    assert image_header(jpeg()) == ("jpeg", 64, 48)
    assert image_header(jpeg()[:20]) == ("jpeg", 0, 0)
    png = cv2.imencode(".png", random(8, 5, 9))[1].tobytes()
    assert image_header(png[:32]) == ("png", 9, 5)
    assert image_header(png[:12]) == ("png", 0, 0)
    assert image_header(memoryview(b"")) == ("", 0, 0)
    assert image_header(b"no picture at all, just text of some length") == ("", 0, 0)


@pytest.mark.parametrize("extension", [".jpg", ".png", ".tiff", ".bmp", ".webp", ".pgm"])
@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
def test_a_cut_image_is_an_error_and_says_nothing_on_stderr(
    extension: str, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    data = cv2.imencode(extension, random(8, 64, 64))[1].tobytes()
    cut = data[: int(len(data) * share)]
    name = image_header(data)[0]
    with pytest.raises(ImageError, match=rf"cam \(frame 7\): image of encoding '{name}'"):
        sample(name, cut).grey()
    with pytest.raises(ImageError):
        sample(name, cut).colour()
    assert capfd.readouterr().err == ""


def test_bytes_after_the_end_of_a_jpeg_do_no_harm() -> None:
    assert sample("jpeg", jpeg() + bytes(64)).grey().shape == (48, 64)


def test_cut_jpeg_whose_thumbnail_is_whole_is_found() -> None:
    thumbnail = jpeg(8, 8)
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = jpeg()[:2] + segment + jpeg()[2:]
    assert sample("jpeg", whole).grey().shape == (48, 64)
    with pytest.raises(ImageError, match="cut short"):
        sample("jpeg", whole[:-30]).grey()


@pytest.mark.parametrize(
    ("encoding", "fields", "length", "words"),
    [
        ("mono8", {}, H * W - 1, r"6 rows of 8 bytes need 48 bytes, but it holds 47"),
        ("mono8", {"step_bytes": 10}, H * W, r"need 60 bytes"),
        ("mono8", {"step_bytes": 4}, H * W, r"step is 4 bytes"),
        ("rgb8", {"width_px": 0}, 100, r"size is 0 x 6 px"),
        ("rgb8", {"width_px": 2**31, "height_px": 2**31}, 100, r"but it holds 100"),
        ("nv12", {}, H * W, r"need 72 bytes"),
        ("bayer_rggb8", {"width_px": 2, "height_px": 2}, 4, r"below 3 x 3"),
        ("jpeg", {}, 0, r"0 bytes"),
        ("jpeg", {}, 10, r"OpenCV cannot decode its 10 bytes"),
        ("16UC1; compressedDepth png", {}, 10, r"compressedDepth"),
        ("h264", {}, 10, r"not known; known are rgb8, .*mono8.*jpeg"),
        ("32FC1", {}, 10, r"distances"),
        ("64FC1", {}, 10, r"not known"),
    ],
)
def test_what_cannot_be_decoded_says_why(encoding: str, fields: dict[str, int], length: int, words: str) -> None:
    image = sample(encoding, bytes(length), **fields)
    for decode in (image.grey, image.colour):
        with pytest.raises(ImageError, match=words) as caught:
            decode()
        assert "cam (frame 7)" in str(caught.value)
        assert encoding in str(caught.value)


def test_colour_of_half_a_pixel_pair_is_refused() -> None:
    image = sample("uyvy", bytes(200), width_px=7)
    assert image.grey().shape == (H, 7)
    with pytest.raises(ImageError, match="7 x 6 px does not suit"):
        image.colour()


def test_float_tiff_is_refused() -> None:
    data = cv2.imencode(".tiff", np.zeros((4, 4), np.float32))[1].tobytes()
    with pytest.raises(ImageError, match="float32"):
        sample("tiff", data).grey()


def test_every_encoding_that_the_workbench_promises_is_there() -> None:
    promised = [
        "mono8",
        "mono16",
        "yuv422",
        "yuv422_yuy2",
        "yuyv",
        "uyvy",
        "nv12",
        "nv21",
        "nv24",
        "8uc1",
        "16uc1",
        "8uc3",
    ]
    promised += [f"{order}{bits}" for order in ("rgb", "bgr", "rgba", "bgra") for bits in (8, 16)]
    promised += [f"bayer_{order}{bits}" for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)]
    assert set(promised) <= set(RAW_FORMATS)
    assert {"jpeg", "png"} <= set(COMPRESSED_FORMATS)


# ---------------------------------------------------------------------------------- depth


def packed_rvl(values: NDArray[np.generic]) -> bytes:
    """RVL by the paper's description, plainly: runs of zeros, runs of differences, numbers in nibbles."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while number > 7:
            nibbles.append(8 | (number & 7))
            number >>= 3
        nibbles.append(number)

    flat, at, before = values.astype(int).ravel().tolist(), 0, 0
    while at < len(flat):
        zeros = next((k for k, v in enumerate(flat[at:]) if v), len(flat) - at)
        put(zeros)
        at += zeros
        run = next((k for k, v in enumerate(flat[at:]) if not v), len(flat) - at)
        put(run)
        for value in flat[at : at + run]:
            difference = value - before
            put(2 * difference if difference >= 0 else -2 * difference - 1)
            before = value
        at += run
    nibbles += [0] * (-len(nibbles) % 8)
    words = [sum(n << (28 - 4 * k) for k, n in enumerate(nibbles[i : i + 8])) for i in range(0, len(nibbles), 8)]
    return np.array(words, "<u4").tobytes()


def compressed_depth(values: NDArray[np.generic], how: str, a: float = 0.0, b: float = 0.0) -> bytes:
    head = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
    if how == "png":
        return head + cv2.imencode(".png", values)[1].tobytes()
    height, width = values.shape
    return head + np.array([width, height], "<i4").tobytes() + packed_rvl(values)


@pytest.mark.parametrize("how", ["png", "rvl"])
@pytest.mark.parametrize("holes", [0.0, 0.5, 1.0])
def test_compressed_depth_of_millimetres(how: str, holes: float) -> None:
    values = RNG.integers(1, 65536, (37, 23)).astype(np.uint16)
    values[RNG.random(values.shape) < holes] = 0
    found = sample(f"16UC1; compressedDepth {how}", compressed_depth(values, how), width_px=0, height_px=0).depth()
    np.testing.assert_allclose(found, np.where(values == 0, np.nan, values / 1000), rtol=1e-6)
    assert found.dtype == np.float32
    assert not found.flags.writeable


@pytest.mark.parametrize("how", ["png", "rvl"])
def test_compressed_depth_of_metres_is_stored_as_inverse_depth(how: str) -> None:
    depth = RNG.uniform(0.5, 9.5, (20, 30))
    quantum, greatest = 100.0, 10.0  # as the writer does it: A = z0 (z0 + 1), B = 1 - A / z_max
    a = quantum * (quantum + 1)
    b = 1.0 - a / greatest
    stored_values = np.rint(a / depth + b).astype(np.uint16)
    stored_values[0, :5] = 0
    found = sample("32FC1; compressedDepth", compressed_depth(stored_values, how, a, b)).depth()
    assert np.isnan(found[0, :5]).all()
    np.testing.assert_allclose(found[1:], depth[1:], atol=9.5**2 / a)


@pytest.mark.parametrize("big", [False, True])
def test_raw_depth(big: bool) -> None:
    metres = RNG.uniform(0.1, 50.0, (H, W)).astype(np.float32)
    metres[0, :4] = np.nan, 0.0, np.inf, -1.0
    step = 4 * W + 8
    found = sample("32FC1", stored(metres, step=step, big=big), step_bytes=step, big_endian=big).depth()
    assert np.isnan(found[0, :4]).all()
    np.testing.assert_array_equal(found[1:], metres[1:])
    with pytest.raises(ImageError, match=r"distances, not a picture; depth\(\) reads them"):
        sample("32FC1", stored(metres)).grey()
    values = RNG.integers(0, 65536, (H, W)).astype(np.uint16)
    expected = np.where(values == 0, np.nan, values / 1000)
    np.testing.assert_allclose(sample("16UC1", stored(values, big=big), big_endian=big).depth(), expected, rtol=1e-6)


def test_damaged_and_hostile_depth_is_refused() -> None:
    good = compressed_depth(RNG.integers(1, 9999, (20, 30)).astype(np.uint16), "rvl")
    huge = good[:12] + np.array([2**20, 2**20], "<i4").tobytes() + good[20:]
    negative = good[:12] + np.array([-30, 20], "<i4").tobytes() + good[20:]
    for data, words in (
        (good[:10], "too few"),
        (good[:60], "do not hold 600 px"),
        (huge, "claims a size"),
        (negative, "claims a size"),
        (good[:20] + b"\xff" * 200, "do not hold"),
        (good[:20] + b"\0" * 400, "do not hold"),
        (compressed_depth(np.zeros((4, 4), np.uint8), "png"), "one channel of 16 bits"),
    ):
        with pytest.raises(ImageError, match=words):
            sample("16UC1; compressedDepth", data).depth()
    with pytest.raises(ImageError, match="no distances"):
        sample("mono8", bytes(H * W)).depth()


def test_random_bytes_never_break_the_unpacking_of_depth() -> None:
    rng = np.random.default_rng(11)
    for size in rng.integers(0, 300, 300):
        data = bytes(12) + np.array([40, 30], "<i4").tobytes() + rng.bytes(int(size))
        try:
            assert sample("16UC1; compressedDepth rvl", data).depth().shape == (30, 40)
        except ImageError:
            continue


def test_a_small_file_that_claims_a_huge_picture_is_refused_before_it_is_unpacked() -> None:
    png = bytearray(cv2.imencode(".png", np.zeros((2, 2), np.uint8))[1].tobytes())
    png[16:24] = (30_000).to_bytes(4, "big") * 2
    with pytest.raises(ImageError, match="claims a size of 30000 x 30000 px"):
        sample("png", bytes(png)).grey()
