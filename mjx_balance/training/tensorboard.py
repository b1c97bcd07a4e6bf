"""Curves for TensorBoard, in its format of records: length, checksum, event, checksum."""

import socket
import struct
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.record_writer import masked_crc32c
from tensorboardX.summary import scalar


class Board:
    """A file of events that are written when they happen.

    The thread of a `SummaryWriter` writes up to two minutes later, and blocks the run when it has
    died of a full disk.
    """

    def __init__(self, folder: Path, purge_step: int | None = None, suffix: str = ""):
        """Creates the file.

        Args:
          folder: of all event files of a run.
          purge_step: first step that the folder's other files no longer count for.
          suffix: of the file's name.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self._file = (
            folder / f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}{suffix}"
        )
        events = [Event(wall_time=time.time(), file_version="brain.Event:2")]
        if purge_step is not None:
            start = SessionLog(status=SessionLog.START)
            events.append(Event(wall_time=time.time(), step=purge_step, session_log=start))
        self._append(events)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Adds a point to each curve; raises `OSError` if the disk is full."""
        now = time.time()
        self._append(
            Event(wall_time=now, step=step, summary=scalar(name, value))
            for name, value in values.items()
        )

    def _append(self, events: Iterable[Event]) -> None:
        with self._file.open("ab") as file:
            for event in events:
                content = event.SerializeToString()
                length = struct.pack("<Q", len(content))
                for part in (length, content):
                    file.write(part + struct.pack("<I", masked_crc32c(part)))
