"""``armcal bag``: what a recording holds, and images taken out of it."""

from __future__ import annotations

from pathlib import Path

import click
import yaml
from armcal.cli.common import FILE, Console, speaking
from armcal.cli.console import columned

from armcal_ros2.bag import Bag


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
    table = columned("Topics", ("topic", "type", "messages", "from s", "to s"), left=("type",))
    begin = min((topic.first for topic in content.topics.values()), default=0.0)
    for name, topic in content.topics.items():
        table.add_row(name, topic.type, str(topic.count), f"{topic.first - begin:.1f}", f"{topic.last - begin:.1f}")
    console.out.print(table)
    for name, log in content.joints.items():
        lengths = [rest.end - rest.begin for rest in log.rests]
        spans = f" of {min(lengths):.1f} to {max(lengths):.1f} s" if lengths else ""
        console.line(f"{name}: {len(lengths)} rests{spans}; joints {', '.join(log.names)}.")
    for remark in content.remarks:
        console.warn(remark)
    if data:
        console.line("A data section for a configuration:")
        console.out.print(yaml.safe_dump({"data": data}, sort_keys=False, default_flow_style=None), soft_wrap=True)
