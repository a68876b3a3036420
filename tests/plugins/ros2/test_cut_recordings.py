"""Recordings that were cut off or damaged give what they have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import recorded_bags as bags
from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.run.experiment import Experiment
from armcal_ros2.bag import Bag

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


@pytest.mark.parametrize(("storage", "compressed"), KINDS)
def test_a_file_that_was_cut_off_gives_what_comes_before(tour: bags.Tour, storage: str, compressed: str) -> None:
    bag, file = recorded(tour, f"cut_{storage}{compressed}", storage, compressed)
    whole, content = read(tour, bag), file.read_bytes()
    lengths = []
    for part in (0.9, 0.7, 0.5):
        file.write_bytes(content[: int(part * len(content))])
        cut = read(tour, bag)
        lengths.append(len(cut) / len(whole))
        shared = min(len(cut), len(whole)) - 1  # of the last rest a part is missing
        np.testing.assert_array_equal(cut.stacked(bags.CHANNELS)[:, :shared], whole.stacked(bags.CHANNELS)[:, :shared])
        assert any("is cut off or damaged" in text for text in cut.warnings)
    assert lengths == pytest.approx((0.9, 0.7, 0.5), abs=0.13)
    (bag / "metadata.yaml").unlink()
    assert any("metadata.yaml is missing" in text for text in read(tour, bag).warnings)


@pytest.mark.parametrize("compressed", ["", "storage"])
def test_every_cut_gives_a_beginning_of_the_whole(tour: bags.Tour, compressed: str) -> None:
    bag, file = recorded(tour, f"cuts_{compressed}", "mcap", compressed)
    content = file.read_bytes()
    whole = list(Bag(bag).messages(lambda topic: True))
    count = len(whole)
    for length in np.linspace(len(content), 0, 23).astype(int)[1:-1]:
        file.write_bytes(content[:length])
        cut = Bag(bag)
        messages = list(cut.messages(lambda topic: True))
        assert messages == whole[: len(messages)] and len(messages) <= count
        assert cut.remarks
        count = len(messages)
    file.write_bytes(b"")
    with pytest.raises(DataError, match="other content than that of an MCAP file"):
        list(Bag(bag).messages(lambda topic: True))


def test_a_damaged_chunk_costs_no_more_than_itself(tour: bags.Tour) -> None:
    bag, file = recorded(tour, "damaged", "mcap", "storage")
    content = bytearray(file.read_bytes())
    whole = list(Bag(bag).messages(lambda topic: True))
    first = content.index(b"\x28\xb5\x2f\xfd")
    second = content.index(b"\x28\xb5\x2f\xfd", first + 4)
    content[first + 2000 : first + 2300] = bytes(300)
    file.write_bytes(content)
    damaged = Bag(bag)
    messages = list(damaged.messages(lambda topic: True))
    assert second < len(content) and 0 < len(messages) < len(whole)
    assert messages[-1] == whole[-1]
    assert ["the chunk at byte" in remark for remark in damaged.remarks] == [True]


def test_rows_that_only_a_journal_holds_are_read(tour: bags.Tour, tmp_path: Path) -> None:
    """A recorder with a write-ahead log that was killed: nothing of the last seconds is in the file itself."""
    import shutil
    import sqlite3

    bag, file = recorded(tour, "journal", "sqlite3", "")
    count = len(list(Bag(bag).messages(lambda topic: False)))
    writer = sqlite3.connect(file)
    writer.execute("PRAGMA journal_mode = WAL")
    writer.execute("PRAGMA wal_autocheckpoint = 0")
    writer.executemany(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, x'00')", [(i,) for i in range(200)]
    )
    writer.commit()
    killed = tmp_path / "killed"
    shutil.copytree(bag, killed)
    writer.close()
    assert len(list(Bag(killed).messages(lambda topic: False))) == count + 200


def test_listed_files_that_are_missing_are_named(tour: bags.Tour) -> None:
    bag, file = recorded(tour, "listed", "mcap", "")
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(text.replace(f"- {file.name}", f"- {file.name}\n  - other_1.mcap", 1))
    assert any("lists other_1.mcap, which is not there" in remark for remark in Bag(bag).remarks)
    metadata.write_text("rosbag2: [")
    assert any("metadata.yaml is damaged" in remark for remark in Bag(bag).remarks)
    file.unlink()
    with pytest.raises(DataError, match=r"no file \.mcap or \.db3"):
        Bag(bag)
