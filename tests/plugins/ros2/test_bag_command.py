"""``armcal bag``: what a recording holds, and bad input."""

from __future__ import annotations

import json

import pytest
import recorded_bags as bags
import yaml
from armcal.run.experiment import Experiment
from armcal_ros2.bag_command import bag as command
from click.testing import CliRunner


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> bags.Tour:
    return bags.made_tour(tmp_path_factory.mktemp("tour"), rests=6)


def test_info_lists_topics_and_rests_and_suggests_a_data_section_that_reads(tour: bags.Tour) -> None:
    path = bags.write_bag(tour.config.with_name("listed"), tour.sent())
    done = CliRunner().invoke(command, ["info", str(path), "--json"], catch_exceptions=False)
    content = json.loads(done.stdout)
    assert content["topics"]["/joint_states"]["count"] == len(tour.joints[0])
    assert content["topics"]["/tip"]["type"] == "geometry_msgs/msg/PointStamped"
    assert content["topics"]["/tip"]["frames"] == {"world": len(tour.seen[0])}
    assert [len(rests) for rests in content["rests"].values()] == [6]
    settings = yaml.safe_load(tour.config.read_text()) | {"data": content["data"] | {"path": path.name}}
    config = tour.config.with_name("suggested.yaml")
    config.write_text(yaml.safe_dump(settings))
    assert len(Experiment.load(config).read()) == 6
    shown = CliRunner().invoke(command, ["info", str(path)], catch_exceptions=False).stdout
    assert "6 rests of 0.9 to 1.0 s" in shown and "type: rosbag2" in shown
