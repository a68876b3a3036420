"""What a recording holds: messages of topics, as bytes."""

from typing import NamedTuple

MAX_BYTES = 1 << 44
JOINT_STATE = "sensor_msgs/msg/JointState"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


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
