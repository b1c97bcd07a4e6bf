"""Reads back the videos that tests have written."""

import re
import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np


def read(path: Path) -> tuple[float, np.ndarray]:
    """Frames per second, and the frames (n, height, width, 3)."""
    # By ffmpeg itself: imageio's readers leave pipes open, which is a warning.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path)]
    done = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    said = done.stderr.decode()
    width, height = map(int, re.findall(r"Video: .*?(\d{2,})x(\d{2,})", said)[0])
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)
    return float(re.findall(r"([\d.]+) fps", said)[0]), frames.astype(float)
