"""Joints as a user names them, and which of several statements of limits holds."""

from __future__ import annotations

import pytest
from armcal.arm.joints import by_dimension, joint_limits, unknown_joint
from armcal.arm.model import Attachment, Chain, Joint, Mimic
from armcal.base import se3
from armcal.errors import ConfigError

JOINTS = (
    Joint("q1", se3.identity(), limits=(-1.0, 1.0)),
    Joint("q2", se3.identity()),
    Joint("follower", se3.identity(), mimic=Mimic("q1")),
)
CHAIN = Chain(se3.identity(), JOINTS, Attachment(3, se3.identity()))


def test_limits_stated_first_win_then_the_model_s() -> None:
    assert joint_limits(CHAIN) == {"q1": (-1.0, 1.0), "q2": None}
    assert joint_limits(CHAIN, {"q1": (0.0, 2.0)}, {"q1": (5.0, 6.0), "q2": (3.0, 4.0)}) == {
        "q1": (0.0, 2.0),
        "q2": (3.0, 4.0),
    }


@pytest.mark.parametrize("name", ["q9", "follower"])
def test_limits_of_no_commanded_joint_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"no joint is called '{name}'; the joints are q1, q2"):
        joint_limits(CHAIN, {}, {name: (0.0, 1.0)})


def test_the_first_unknown_name_is_told_with_the_known_ones() -> None:
    assert unknown_joint(["q1"], ["q1", "q2"]) == ""
    assert unknown_joint(["q1", "b", "a"], ["q1"]) == "no joint is called 'b'; the joints are q1"
    assert unknown_joint(["b"], []) == "no joint is called 'b'; the joints are none"


def test_turning_and_sliding_joints_stand_under_their_own_keys() -> None:
    joints = {"q1": "angle", "lift": "length"}
    assert by_dimension(joints, {"q1": 1}, {"lift": 2}) == {"q1": 1, "lift": 2}
    with pytest.raises(ConfigError, match=r"plan.limits: no turning joint is called 'lift'; the turning joints are q1"):
        by_dimension(joints, {"lift": 1}, {})
    with pytest.raises(ConfigError, match=r"b: no sliding joint is called 'q1'; the sliding joints are lift"):
        by_dimension(joints, {}, {"q1": 1}, ("a", "b"))
