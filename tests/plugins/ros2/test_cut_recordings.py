"""Recordings that were cut off or damaged give what they have."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from pathlib import Path
from random import Random

import numpy as np
import pytest
import recorded_bags as bags
from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.run.experiment import Experiment
from armcal_ros2.bag_command import survey
from armcal_ros2.reader import Bag
from rosbags.rosbag2 import Reader

KINDS = [("mcap", ""), ("mcap", "storage"), ("sqlite3", "")]


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> bags.Tour:
    return bags.made_tour(tmp_path_factory.mktemp("tour"), rests=16, joint_hz=300)


def recorded(tour: bags.Tour, name: str, storage: str, compressed: str) -> tuple[Path, Path]:
    """The recording and its only data file."""
    bag = bags.write_bag(tour.config.with_name(name), tour.sent(), storage, compressed)
    (file,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
    return bag, file


def read(tour: bags.Tour, bag: Path) -> Dataset:
    return Experiment.load(bags.of_bag(tour, bag)).read()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_file_that_was_cut_off_is_refused_with_what_makes_it_whole(tour: bags.Tour, storage: str) -> None:
    bag, file = recorded(tour, f"cut_{storage}", storage, "")
    file.write_bytes(file.read_bytes()[:-5000])
    with pytest.raises(DataError, match=r"cut off, damaged or no recording.*mcap recover FILE.*reindex FOLDER"):
        read(tour, bag)


@pytest.mark.parametrize(("storage", "compressed"), KINDS)
def test_without_metadata_the_files_are_read(tour: bags.Tour, storage: str, compressed: str) -> None:
    bag, _ = recorded(tour, f"bare_{storage}{compressed}", storage, compressed)
    whole = read(tour, bag)
    (bag / "metadata.yaml").unlink()
    bare = read(tour, bag)
    np.testing.assert_array_equal(bare.stacked(bags.CHANNELS), whole.stacked(bags.CHANNELS))
    assert any("metadata.yaml is missing" in text for text in bare.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(("storage", "compressed"), [*KINDS, ("mcap", "message"), ("sqlite3", "message")])
def test_only_chosen_topics_are_read_and_all_are_counted(tour: bags.Tour, storage: str, compressed: str) -> None:
    bag, _ = recorded(tour, f"read_{storage}{compressed}", storage, compressed)
    with Reader(bag) as reader:
        expected = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
    chosen = Bag(bag)
    read = chosen.messages(lambda topic: topic.name == "/tip")
    messages = [(topic.name, received, data) for topic, received, data, _ in read]
    assert messages == [one for one in expected if one[0] == "/tip"]
    assert chosen.topics.total() == len(expected)


@pytest.mark.quick("sqlite3-")
@pytest.mark.parametrize(("storage", "compressed"), KINDS)
def test_damaged_bytes_never_end_in_a_traceback(tour: bags.Tour, storage: str, compressed: str) -> None:
    bag, file = recorded(tour, f"damaged_{storage}{compressed}", storage, compressed)
    random, content = Random(1), file.read_bytes()[: 1 << 16]
    for _ in range(40):
        damaged = bytearray(content)
        for _ in range(random.choice([1, 3, 20])):
            at, length = random.randrange(len(damaged)), random.choice([1, 4, 64])
            damaged[at : at + length] = random.choice([bytes(length), b"\xff" * length, random.randbytes(length)])
        file.write_bytes(damaged)
        with contextlib.suppress(DataError):
            survey(Bag(bag))


def test_rows_that_only_a_journal_holds_are_named(tour: bags.Tour, tmp_path: Path) -> None:
    """A recorder with a write-ahead log that was killed: nothing of the last seconds is in the file itself."""
    bag, file = recorded(tour, "journal", "sqlite3", "")
    writer = sqlite3.connect(file)
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute("PRAGMA wal_autocheckpoint = 0")
    writer.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 1, x'00')")
    writer.commit()
    killed = tmp_path / "killed"
    shutil.copytree(bag, killed)
    writer.close()
    assert any("holds messages that are not read" in remark for remark in Bag(killed).remarks)


def test_a_metadata_file_that_cannot_be_used_is_refused_with_what_makes_another(tour: bags.Tour) -> None:
    bag, file = recorded(tour, "listed", "mcap", "")
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    for damaged in (text.replace(f"- {file.name}", f"- {file.name}\n  - other_1.mcap", 1), "rosbag2: ["):
        metadata.write_text(damaged)
        with pytest.raises(DataError, match=r"reindex FOLDER the metadata\.yaml"):
            read(tour, bag)
    file.unlink()
    metadata.unlink()
    with pytest.raises(DataError, match=r"no metadata.yaml and no file \.mcap or \.db3"):
        Bag(bag)
