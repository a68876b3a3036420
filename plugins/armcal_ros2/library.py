"""The library ``rosbags``, which knows ROS 2's messages, and the decompressors that come with it."""

import contextlib
import importlib
import io
from functools import cache
from typing import Any

from armcal.extras import library

_PIECE_BYTES = 64 * 1024


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
