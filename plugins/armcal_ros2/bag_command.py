"""``armcal bag``: what a recording holds, and images taken out of it."""

from pathlib import Path
from typing import Any

import click
import yaml
from armcal.cli.common import FILE, Console, speaking

from armcal_ros2.bag import IMAGES, Bag


@click.group()
def bag() -> None:
    """Look into a recording of ROS 2 (rosbag2), and take images out of it."""


@bag.command()
@click.argument("path", type=FILE)
@speaking
def info(console: Console, path: Path) -> None:
    """Topics, times and rests of the recording PATH, and a data section for a configuration."""
    from armcal_ros2.survey import survey

    content = survey(Bag(path))
    data = content.data(path)
    console.result({**content.content(), "data": data})
    begin = min((topic.first for topic in content.topics.values() if topic.first is not None), default=0.0)
    rows = (
        (name, topic.type, topic.count, *("" if t is None else f"{t - begin:.1f}" for t in (topic.first, topic.last)))
        for name, topic in content.topics.items()
    )
    console.table("Topics", ("topic", "type", "messages", "from s", "to s"), rows, left=("type",))
    for name, log in content.joints.items():
        lengths = [rest.end - rest.begin for rest in log.rests]
        spans = f" of {min(lengths):.1f} to {max(lengths):.1f} s" if lengths else ""
        console.line(f"{name}: {len(lengths)} rests{spans}; joints {', '.join(log.names)}.")
    for remark in content.remarks:
        console.warn(remark)
    pictures = [name for name, topic in content.topics.items() if topic.type in IMAGES]
    if data.get("measurements"):
        _show_data(console, data, "names" in data["joints"])
    for name in pictures if data else ():
        console.line(f"Images of its rests: armcal bag images {path} --topic {name} --out FOLDER")


@bag.command()
@click.argument("path", type=FILE)
@click.option("--out", required=True, type=FILE, help="The folder for images, joints.csv and camera_info.yaml.")
@click.option("--topic", metavar="NAME", help="Of the images, where there are several.")
@click.option("--joints", metavar="NAME", help="Of the joint states, where there are several.")
@click.option("--clock-offset-ms", default=0.0, help="How far the camera's clock is ahead of that of the joints.")
@speaking
def images(
    console: Console, path: Path, out: Path, topic: str | None, joints: str | None, clock_offset_ms: float
) -> None:
    """Take one image of each rest out of the recording PATH, for the reader images."""
    from armcal_ros2.survey import extract

    extracted = extract(Bag(path), out, topic, joints, clock_offset_ms / 1000)
    data: dict[str, Any] = {"type": "images", "folder": str(out), "poses": str(out / "joints.csv")}
    console.result({"images": list(extracted.images), "files": [str(file) for file in extracted.files], "data": data})
    console.line(f"{len(extracted.images)} images written: {out}")
    for remark in extracted.remarks:
        console.warn(remark)
    named = not set(extracted.joints) <= {f"q{i}" for i in range(1, len(extracted.joints) + 1)}
    if named:
        names = {f"q{i}_rad": f"{name}_rad" for i, name in enumerate(extracted.joints, start=1)}
        data["poses"] = {"type": "csv", "path": str(out / "joints.csv"), "columns": names}
    _show_data(console, data, named)


def _show_data(console: Console, data: dict[str, Any], named: bool) -> None:
    console.line("A data section for a configuration:")
    console.out.print(yaml.safe_dump({"data": data}, sort_keys=False, default_flow_style=None), soft_wrap=True)
    if named:
        console.line("# Leave q1, q2, ... out where the arm's joints are called as in the recording, as in a URDF.")
