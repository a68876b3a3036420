"""Names of arms, effects, links, joints and groups: refused where they are written if nothing could address them."""

from __future__ import annotations

from pathlib import Path

import pytest
from armcal.base.dataset import Dataset
from armcal.errors import ConfigError, DataError
from armcal.measure.groups import record_keys
from armcal.measure.measurement import Contact
from armcal.run.experiment import Experiment
from outside import armcal

CONFIG = """
arms:
  ARM:
    model: {type: poe, joints: [{name: "JOINT", kind: revolute, axis: [0, 0, 1], point_m: [0, 0, 0]}], tool: {position_m: [0.3, 0, 0]}}
    effects:
      "EFFECT": {type: torsional_spring}
    links:
      "LINK": {mass_g: 10, com_mm: [0, 0, 0], frame: tool}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {TRACKER: {type: tip_position, noise_mm: 0.1}}
"""  # noqa: E501
SOUND = {"ARM": "arm", "JOINT": "q1", "EFFECT": "spring", "LINK": "hand", "TRACKER": "tracker"}


def written(folder: Path, **names: str) -> Path:
    text = CONFIG
    for key, name in {**SOUND, **names}.items():
        text = text.replace(key, name)
    path = folder / "arm.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["front-spring", "spring_2", "Feder", "弹簧"])
def test_ordinary_names_are_taken(tmp_path: Path, name: str) -> None:
    found = Experiment.load(written(tmp_path, EFFECT=name, LINK=f"{name}-link", JOINT=f"{name}-joint"))
    assert f"arm.{name}.k1" in found.parameters.names


@pytest.mark.parametrize("name", ["x[0]", "a.b", "k*", "two words", "a?", "it's", "<b>", "a@other", "esc\\e[31m"])
@pytest.mark.parametrize(("key", "line"), [("EFFECT", 6), ("LINK", 8), ("JOINT", 4)])
def test_names_that_nothing_could_address_are_refused(tmp_path: Path, name: str, key: str, line: int) -> None:
    with pytest.raises(ConfigError, match=r"found the (effect|link|joint) name") as fault:
        Experiment.load(written(tmp_path, **{key: name}))
    where = fault.value.where
    assert where is not None and where.line in (line, 5, 7)


@pytest.mark.parametrize(("key", "name", "line"), [("ARM", '"x[0]"', 3), ("TRACKER", '"a.b"', 10)])
def test_instances_too(tmp_path: Path, key: str, name: str, line: int) -> None:
    with pytest.raises(ConfigError, match="is no instance name") as fault:
        Experiment.load(written(tmp_path, **{key: name}))
    assert fault.value.where is not None and fault.value.where.line == line


@pytest.mark.parametrize("name", ["poe", "links"])
def test_an_effect_is_not_called_as_another_part_of_the_arm(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="which is taken"):
        Experiment.load(written(tmp_path, EFFECT=name))


def test_it_is_said_before_anything_runs(tmp_path: Path) -> None:
    told = armcal("check", written(tmp_path, EFFECT="x[0]"), code=2).stderr
    assert (
        "arm.yaml:6" in told
        and "found the effect name 'x[0]', expected letters, digits, underscores and dashes" in " ".join(told.split())
    )


@pytest.mark.parametrize("label", ["x[0]", "esc\x1b[31m", "bell\a", "two\nlines"])
def test_labels_of_groups_are_names_too(label: str) -> None:
    class Socket(Contact):
        arms, group_labels = ("arm",), ("socket",)

    records = Dataset(("1", "2"), {}, {"socket": ("front left", label)}, rows=(2, 3), source="records.csv")
    with pytest.raises(DataError, match=r"records.csv, row 3: found the label"):
        record_keys(records, Socket())
