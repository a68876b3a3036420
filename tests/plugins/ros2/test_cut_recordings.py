"""Recordings that were cut off or damaged give what they have."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import struct
from pathlib import Path
from random import Random

import lz4.frame
import numpy as np
import pytest
import recorded_bags as bags
from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.run.experiment import Experiment
from armcal_ros2.bag import Bag
from armcal_ros2.survey import survey
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(("storage", "compressed"), [*KINDS, ("mcap", "message"), ("sqlite3", "message")])
def test_messages_are_those_that_rosbags_reads(tour: bags.Tour, storage: str, compressed: str) -> None:
    bag, _ = recorded(tour, f"read_{storage}{compressed}", storage, compressed)
    with Reader(bag) as reader:
        expected = sorted((t, c.topic, c.msgtype, bytes(data)) for c, t, data in reader.messages())
    messages = Bag(bag).messages(lambda topic: True)
    assert sorted((m.received, m.topic.name, m.topic.type, bytes(m.data or b"")) for m in messages) == expected
    passed_over = list(Bag(bag).messages(lambda topic: topic.name == "/tip"))
    assert len(passed_over) == len(expected)
    assert {m.topic.name for m in passed_over if m.data is not None} == {"/tip"}


@pytest.mark.slow
@pytest.mark.parametrize("is_flat", [False, True])
def test_chunks_may_be_compressed_by_lz4_or_missing(tour: bags.Tour, is_flat: bool) -> None:
    """A recorder that writes fast puts messages into the file without chunks."""
    bag, file = recorded(tour, f"other_{is_flat}", "mcap", "")
    whole, content, at, parts = list(Bag(bag).messages(lambda topic: True)), file.read_bytes(), 8, []
    while at < len(content) - 8:
        code, length = struct.unpack_from("<BQ", content, at)
        record = content[at + 9 : at + 9 + length]
        if code == 6 and not is_flat:
            packed = lz4.frame.compress(record[40:])
            record = record[:28] + struct.pack("<I", 3) + b"lz4" + struct.pack("<Q", len(packed)) + packed
        parts.append(record[40:] if code == 6 and is_flat else struct.pack("<BQ", code, len(record)) + record)
        at += 9 + length
    file.write_bytes(content[:8] + b"".join(parts) + content[-8:])
    assert is_flat or file.stat().st_size < 0.8 * len(content)
    assert list(Bag(bag).messages(lambda topic: True)) == whole


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


@pytest.mark.slow
def test_rows_that_only_a_journal_holds_are_read(tour: bags.Tour, tmp_path: Path) -> None:
    """A recorder with a write-ahead log that was killed: nothing of the last seconds is in the file itself."""
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
