"""Videos that browsers and slides play."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from multilift_marl.errors import RenderingError, pip_install


class VideoWriter:
    """Writes an mp4 (H.264, yuv420p) that browsers and slides play, frame by frame.

    Args:
        path: of the file; its folder is made.
        fps: pictures each second.

    Raises:
        RenderingError: imageio or av is not installed.
    """

    def __init__(self, path: str | Path, fps: float):
        try:
            import av  # noqa: F401  (imageio's plugin needs it and says so less clearly)
            import imageio.v3 as iio
        except ImportError as error:
            raise RenderingError(f"writing {path} needs {error.name}: {pip_install('train')}") from error
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        self._file = iio.imopen(path, "w", plugin="pyav")
        self._file.init_video_stream("libx264", fps=float(fps), pixel_format="yuv420p")

    def append(self, frame: np.ndarray) -> None:
        """Add a picture (H, W, 3) uint8, the same size every time; an odd last row or column is cut off."""
        self._file.write_frame(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])

    def close(self) -> None:
        """Finish the file."""
        self._file.close()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures (H, W, 3) uint8, taken one at a time, as an mp4; see VideoWriter.

    Raises:
        RenderingError: imageio or av is not installed, or there are no frames.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise RenderingError(f"there are no frames to write to {path}")
    with VideoWriter(path, fps) as video:
        video.append(first)
        for frame in frames:
            video.append(frame)
