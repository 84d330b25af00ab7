"""Recordings of ROS 1 (.bag) and ROS 2 (sqlite3, MCAP), through rosbags (extra ``bags``).

Message definitions that a recording brings along are not used: only standard messages are
read, by the definitions of rosbags itself, so nothing in a file becomes code.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frontends.errors import DependencyError, InputError
from lunar_fg.datasets.strict_yaml import read_yaml

METADATA = "metadata.yaml"
#: Recordings in one file; a ROS 2 folder holds one or more of the last two beside its metadata.
SUFFIXES = (".bag", ".mcap", ".db3")
_MOST_TOPICS = 2000


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True, slots=True)
class BagFile:
    """A recording that can be read any number of times.

    Attributes
    ----------
    path
        ``.bag``, ``.mcap`` or ``.db3`` file, or the folder of a ROS 2 recording.
    """

    path: Path

    def topics(self) -> tuple[Topic, ...]:
        """List what was recorded, by name.

        Raises
        ------
        InputError
            When the recording cannot be read.
        DependencyError
            When rosbags is not installed.
        """
        with self._open() as reader:
            counts: dict[tuple[str, str], int] = {}
            for connection in reader.connections:
                key = (str(connection.topic), str(connection.msgtype))
                counts[key] = counts.get(key, 0) + int(connection.msgcount)
        if len(counts) > _MOST_TOPICS:
            raise InputError(f"holds more than {_MOST_TOPICS} topics", source=self.path)
        return tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def raw(self, topics: Collection[str]) -> Iterator[tuple[str, bytes]]:
        """Read the serialised messages of some topics in the order of the recording.

        Raises
        ------
        InputError
            When the recording breaks off.
        """
        with self._open() as reader:
            chosen = [each for each in reader.connections if each.topic in topics]
            for connection, _, data in reader.messages(connections=chosen):
                yield str(connection.topic), bytes(data)

    def decode(self, data: bytes, kind: str) -> Any:
        """Deserialise a message of a standard type.

        Raises
        ------
        InputError
            When the bytes are not such a message.
        """
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.ROS2_HUMBLE)
        try:
            if self._is_ros1:
                return store.deserialize_ros1(data, kind)
            return store.deserialize_cdr(data, kind)
        # the parser runs over untrusted bytes: whatever it stumbles over is the file's fault
        except Exception as error:
            raise InputError(f"is no {kind}: {_brief(error)}", source=self.path) from error

    @property
    def _is_ros1(self) -> bool:
        return self.path.suffix == ".bag"

    @contextmanager
    def _open(self) -> Iterator[Any]:
        try:
            from rosbags import rosbag1, rosbag2
        except ImportError as error:
            raise DependencyError(
                "reading recordings needs rosbags: pip install 'lunar-fg[bags]'"
            ) from error
        if (self.path / METADATA).is_file():
            _check_metadata(self.path / METADATA)
        try:
            reader = rosbag1.Reader(self.path) if self._is_ros1 else rosbag2.Reader(self.path)
            with reader:
                yield reader
        except (InputError, GeneratorExit):
            raise
        except Exception as error:  # as above
            raise InputError(
                f"cannot be read as a recording: {_brief(error)}",
                source=self.path,
                remedy="check that it was copied completely; reindex it where it was cut off",
            ) from error


def find_bag(path: Path) -> BagFile | None:
    """Recording at a path: the path itself, or the only one in a folder."""
    if path.is_file():
        return BagFile(path) if path.suffix in SUFFIXES else None
    if not path.is_dir():
        return None
    if (path / METADATA).is_file():
        return BagFile(path)
    names = sorted(name for name in os.listdir(path) if name.endswith(SUFFIXES))
    return BagFile(path / names[0]) if len(names) == 1 else None


def _check_metadata(file: Path) -> None:
    """Read a ROS 2 recording's metadata strictly before rosbags does."""
    content = read_yaml(file)
    info = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(info, dict):
        raise InputError(
            "is no metadata of a ROS 2 recording", source=file, field="rosbag2_bagfile_information"
        )
    if info.get("compression_format"):
        raise InputError(
            "the recording is compressed as a whole",
            source=file,
            field="compression_format",
            remedy="unpack it with `ros2 bag convert`; chunks of MCAP may stay compressed",
        )
    names = info.get("relative_file_paths")
    for name in names if isinstance(names, list) else [None]:
        if not isinstance(name, str) or Path(name).name != name or name in ("", ".", ".."):
            raise InputError(
                f"{str(name)[:100]!a} is not the name of a file beside it",
                source=file,
                field="relative_file_paths",
            )


def _brief(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
