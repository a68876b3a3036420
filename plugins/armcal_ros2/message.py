"""What a recording holds: messages of topics, as bytes; and ``rosbags``, which knows their types and compressions."""

import contextlib
import importlib
import io
from functools import cache
from typing import Any, NamedTuple

from armcal.plugins import library

MAX_BYTES = 1 << 44
JOINT_STATE = "sensor_msgs/msg/JointState"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_PIECE_BYTES = 64 * 1024


class Topic(NamedTuple):
    """A topic: its name, its messages' type (``sensor_msgs/msg/JointState``) and their encoding (``cdr``)."""

    name: str
    type: str
    encoding: str = "cdr"


class RawMessage(NamedTuple):
    """A message: its topic, when the recorder received it (ns since 1970), and its bytes if they were asked for."""

    topic: Topic
    received: int
    data: bytes | None


@cache
def message_types() -> Any:
    """What turns the bytes of standard messages into objects: a typestore of ``rosbags``.

    Raises:
        PluginError: it is not installed.
    """
    typesys = library("rosbags.typesys", "reading recordings of ROS 2")
    return typesys.get_typestore(typesys.Stores.LATEST)


def decompressed(content: bytes, compression: str) -> io.BytesIO:
    """What was compressed by ``zstd`` or ``lz4``; of content that was cut off or damaged, what comes before."""
    unpacked = io.BytesIO()
    with contextlib.suppress(Exception):  # each library has errors of its own
        if compression == "lz4":
            stream = importlib.import_module("lz4.frame").LZ4FrameDecompressor()
        else:
            try:
                stream = importlib.import_module("compression.zstd").ZstdDecompressor()
            except ImportError:  # before Python 3.14
                stream = importlib.import_module("backports.zstd").ZstdDecompressor()
        for start in range(0, len(content), _PIECE_BYTES):
            unpacked.write(stream.decompress(content[start : start + _PIECE_BYTES]))
    unpacked.seek(0)
    return unpacked
