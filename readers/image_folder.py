"""Image folders: EuRoC ASL, TUM RGB-D, KITTI odometry, surface sets, photos with tables, plain frames."""

from __future__ import annotations

from pathlib import Path

from readers.folder_layouts import open_layout, refuse
from readers.streams import ReadOptions, Recording, RecordingError


def open_folder(path: Path, options: ReadOptions | None = None) -> Recording:
    """Open a folder of images by what it holds.

    Args:
        path: the folder.
        options: frame rate or times of frames that have none.

    Returns:
        The recording. Images are read when their samples are made or decoded; tables are read here.

    Raises:
        RecordingError: it is no folder, holds no images, or nothing tells when they were taken.
    """
    path = Path(path)
    if not path.is_dir():
        raise RecordingError(path, "is not a folder", "give the folder of an image recording")
    try:
        return open_layout(path, options or ReadOptions()) or _raise(refuse(path))
    except OSError as error:
        problem = f"cannot be read ({error.strerror}: {error.filename})"
        raise RecordingError(path, problem, "check that the folder may be read") from None


def _raise(error: RecordingError) -> Recording:
    raise error
