"""What a mission's ``sensors.rrd`` gives back: the samples that an estimator got, with their images."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipelines.replay import grey_sample
from readers.streams import ImageSample, RecordingError, Sample
from workbench.rrd_excerpt import Place, RrdParts
from workbench.rrd_file import IMAGE, numbers
from workbench.rrd_samples import ARCHETYPE, GREY, Stored, entity_of, order_of, samples_of

if TYPE_CHECKING:
    from workbench.runs import Run

Ints = NDArray[np.int64]
_SCALARS = "Scalars:scalars"
_CURE = "replay the recording again"


class SensorReader:
    """Reads the samples of a mission, as many as are asked for.

    Args:
        path: the file that `workbench.rrd.SensorWriter` wrote.
        frame_stream: the stream of the frames.

    Attributes:
        path: the file.
        frames: numbers of the frames, rising [n].
        order: their places in the order of arrival [n].
        t_ns: their sensor times [n].

    Raises:
        RecordingError: the file cannot be read, or holds no samples of the frames' stream.
    """

    def __init__(self, path: Path, frame_stream: str) -> None:
        self.path, self._stream = path, frame_stream
        self._parts = RrdParts(path)
        self._images = self._parts.of([entity_of(frame_stream, GREY)]) + self._parts.of([IMAGE])
        self._held: dict[Place, dict[int, ImageSample]] = {}
        self._batches: dict[str, list[pa.RecordBatch]] = {}
        self.frames, self.order, self.t_ns = self._numbered()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the file."""
        self._parts.close()

    def order_of(self, frame: int) -> int:
        """Place of a frame in the order of arrival.

        Raises:
            RecordingError: the file does not hold that frame.
        """
        at = int(np.searchsorted(self.frames, frame))
        if at == len(self.frames) or self.frames[at] != frame:
            raise RecordingError(self.path, f"holds no frame {frame}", _CURE)
        return int(self.order[at])

    def samples(self, streams: Sequence[str], after: int, upto: int) -> Iterator[Sample]:
        """The samples of the frames' stream and of some others, from behind one place in order up to another included.

        Images come decoded, as `pipelines.replay` gives them to an estimator.

        Raises:
            RecordingError: the image of a frame is not in the file.
        """
        chosen = [
            stored for stream in dict.fromkeys([self._stream, *streams]) for stored in self.bare(stream, after, upto)
        ]
        for stored in sorted(chosen, key=lambda one: one.order):
            yield self.decoded(stored.sample)

    def bare(self, stream: str, after: int = -1, upto: int | None = None) -> list[Stored]:
        """The samples of one stream in the order of arrival, likewise; images without their pixels, see `decoded`."""
        return samples_of(stream, self._of(stream), after, np.iinfo(np.int64).max if upto is None else upto)

    def decoded(self, sample: Sample) -> Sample:
        """A bare sample as an estimator got it: an image with its grey levels, everything else as it is.

        Raises:
            RecordingError: the image is not in the file.
        """
        return grey_sample(self._whole(sample)) if isinstance(sample, ImageSample) else sample

    def grey(self, frame: int) -> NDArray[Any]:
        """Grey levels [height, width] of the image of a frame, as an estimator got them.

        Raises:
            RecordingError: the file holds no such image.
        """
        at = self.order_of(frame)
        for sample in self.samples([], at - 1, at):
            if isinstance(sample, ImageSample):
                return sample.grey()
        raise self._missing(frame)

    # ---- samples

    def _numbered(self) -> tuple[Ints, Ints, Ints]:
        batches = self._of(self._stream)
        if not batches:
            problem = f"holds no samples of {self._stream}: an older version wrote it"
            raise RecordingError(self.path, problem, _CURE)
        frames = np.concatenate([numbers(batch.column("frame")) for batch in batches])
        order = np.concatenate([order_of(batch) for batch in batches])
        t_ns = np.concatenate([numbers(batch.column("sensor_time")) for batch in batches])
        rising = np.argsort(frames, kind="stable")
        return frames[rising], order[rising], t_ns[rising]

    def _of(self, stream: str) -> list[pa.RecordBatch]:
        """The columns of a stream's samples; read but once."""
        if stream not in self._batches:
            batches = self._parts.batches(self._parts.of([entity_of(stream)]))
            self._batches[stream] = [b for _, b in batches if f"{ARCHETYPE}:order" in b.schema.names]
        return self._batches[stream]

    # ---- images

    def _whole(self, sample: ImageSample) -> ImageSample:
        """An image with its bytes: those of the grey levels, else of the picture of that frame."""
        for place in self._images:
            if place.overlaps(sample.frame, sample.frame + 1):
                found = self._load(place).get(sample.frame)
                if found is not None:
                    same = {name: getattr(sample, name) for name in ("stream", "t_ns", "received_ns", "oddities")}
                    return dataclasses.replace(found, **same)
        raise self._missing(sample.frame)

    def _missing(self, frame: int) -> RecordingError:
        return RecordingError(self.path, f"holds no image of frame {frame}", _CURE)

    def _load(self, place: Place) -> dict[int, ImageSample]:
        """The images of a chunk by their frames; those of the last two chunks are held."""
        if place not in self._held:
            while len(self._held) > 1:
                self._held.pop(next(iter(self._held)))
            found: dict[int, ImageSample] = {}
            for _, batch in self._parts.batches([place]):
                found |= dict(_images(batch))
            self._held[place] = found
        return self._held[place]


def sensors_of(run: Run) -> SensorReader:
    """The samples that a run's estimator got.

    Raises:
        RecordingError: the file is missing, or of another recording, window or choice of streams than the run.
    """
    file, again = run.sensors_file, f"{_CURE} into this folder"
    try:
        values = tomllib.loads(file.with_suffix(".toml").read_text("utf-8"))
    except (OSError, ValueError):
        values = None
    if values is None or not file.is_file():
        raise RecordingError(file, "is missing or was not finished", again)
    if values.get("digest") != run.digest:
        cure = f"{_CURE} into a folder of its own"
        raise RecordingError(file, f"is of another recording than {run.name}", cure)
    if "other_streams" not in run.about or "streams" not in values:
        raise RecordingError(run.path("toml"), "is of an older version, which kept no samples", _CURE)
    now = (run.about["image_stream"], run.toml.get("window"), run.about.get("order"))
    if (values.get("frame_stream"), values.get("window"), values.get("order")) != now:
        problem = f"was written again for another window, stream of frames or order of samples than {run.name} has"
        raise RecordingError(file, problem, f"{_CURE}, best into a folder of its own (-o)")
    missing = sorted({*run.about["other_streams"]} - {*values["streams"]})
    if missing:
        raise RecordingError(file, f"holds no samples of {', '.join(missing)}", again)
    return SensorReader(file, run.about["image_stream"])


def read_reference(path: Path) -> tuple[Ints, NDArray[np.float64]] | None:
    """The reference: sensor times [n], x, y (m) and heading (rad) [n, 3]; None where the file has none.

    Raises:
        RecordingError: the file cannot be read.
    """
    with RrdParts(path) as parts:
        batches = [b for _, b in parts.batches(parts.of(["/sensors/reference"])) if _SCALARS in b.schema.names]
    if not batches:
        return None
    t_ns = np.concatenate([numbers(batch.column("sensor_time")) for batch in batches])
    poses = np.concatenate([numbers(batch.column(_SCALARS).flatten()).reshape(-1, 4) for batch in batches])
    return t_ns, poses[:, [0, 1, 3]]


def _images(batch: pa.RecordBatch) -> Iterator[tuple[int, ImageSample]]:
    frames = batch.column("frame").to_pylist()
    names = batch.schema.names
    if "EncodedImage:blob" in names:
        blobs, media = batch.column("EncodedImage:blob"), batch.column("EncodedImage:media_type").to_pylist()
        for i, frame in enumerate(frames):
            if blobs[i].is_valid and len(blobs[i].values):
                data = numbers(blobs[i].values[0].values).tobytes()
                yield frame, _image(frame, encoding=media[i][0].removeprefix("image/"), payload=data)
    elif f"{ARCHETYPE}:grey" in names:
        greys = batch.column(f"{ARCHETYPE}:grey")
        for i, frame in enumerate(frames):
            data = numbers(greys[i].values).tobytes()
            yield frame, _image(frame, encoding="png", payload=data)
    elif "Image:buffer" in names:
        buffers, formats = batch.column("Image:buffer"), batch.column("Image:format").to_pylist()
        for i, frame in enumerate(frames):
            (form,) = formats[i]
            data = numbers(buffers[i].values[0].values).tobytes()
            wide = len(data) == 2 * form["width"] * form["height"]
            yield (
                frame,
                _image(
                    frame,
                    encoding="mono16" if wide else "mono8",
                    payload=data,
                    width_px=form["width"],
                    height_px=form["height"],
                ),
            )


def _image(frame: int, **fields: Any) -> ImageSample:
    return ImageSample(stream="", t_ns=0, received_ns=0, frame=frame, **fields)
