"""Configs as text: what is read, where it is said to stand, and what is refused with which mend."""

from __future__ import annotations

import copy
import json
import os
import pickle
import random
import time
from pathlib import Path

import pytest
import yaml
from armcal.base.config_text import ConfigText, resolve_path
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError

SAMPLE = """\
# an arm with two rows
extends: base.yaml
seed: 7
arms:
  arm:
    model:
      type: mdh
      rows:
        - {name: shoulder, theta_deg: 90, d_mm: 46.9}
        - name: elbow
          a_mm: 37.32
          alpha: "60 deg"
    bounds: off
measurements: &m
  - type: position
    noise_mm: 0.5
    data: data/poses.csv
again: *m
note: |
  text with : colons
  and - dashes
"""
BASE = "seed: 1\narms:\n  arm:\n    gravity_m_s2: [0, 0, -9.81]\n    payload_g: 50\nlog: info\n"


def write(folder: Path, text: str | bytes, name: str = "c.yaml") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def load(folder: Path, text: str | bytes, *overrides: str) -> ConfigSource:
    return load_config(write(folder, text), overrides)


def refusal(folder: Path, text: str | bytes, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, text, *overrides)
    assert caught.value.exit_code == 2
    return str(caught.value)


@pytest.fixture
def sample(tmp_path: Path) -> ConfigSource:
    write(tmp_path, BASE, "base.yaml")
    return load(tmp_path, SAMPLE)


# What is read


def test_the_sample_is_read_and_merged(sample: ConfigSource) -> None:
    rows = [
        {"name": "shoulder", "theta_deg": 90, "d_mm": 46.9},
        {"name": "elbow", "a_mm": 37.32, "alpha": "60 deg"},
    ]
    position = [{"type": "position", "noise_mm": 0.5, "data": "data/poses.csv"}]
    assert sample.data == {
        "seed": 7,
        "log": "info",
        "arms": {
            "arm": {
                "gravity_m_s2": [0, 0, -9.81],
                "payload_g": 50,
                "model": {"type": "mdh", "rows": rows},
                "bounds": False,
            }
        },
        "measurements": position,
        "again": position,
        "note": "text with : colons\nand - dashes\n",
    }
    assert [p.name for p in sample.files] == ["c.yaml", "base.yaml"]


# Where it stands


def test_every_value_knows_its_file_line_and_field(sample: ConfigSource, tmp_path: Path) -> None:
    here, base = str(tmp_path / "c.yaml"), str(tmp_path / "base.yaml")
    row = ("arms", "arm", "model", "rows")
    expected: dict[tuple[str | int, ...], tuple[str, int]] = {
        ("seed",): (here, 3),
        ("arms", "arm", "payload_g"): (base, 5),
        ("arms", "arm", "gravity_m_s2", 2): (base, 4),
        (*row, 0, "d_mm"): (here, 9),
        (*row, 1): (here, 10),
        (*row, 1, "alpha"): (here, 12),
        ("measurements", 0, "noise_mm"): (here, 16),
        ("note",): (here, 19),
    }
    for path, place in expected.items():
        assert path in sample.marks
        mark = sample.where(path)
        assert (mark.file, mark.line) == place, path
        assert mark.field == ".".join(map(str, path))
    assert sample.marks[("again",)].line == 18
    assert set(sample.marks) >= {(), ("log",), ("arms",)}


def test_where_finds_the_nearest_parent_and_a_key_by_its_name_without_unit(sample: ConfigSource) -> None:
    row = ("arms", "arm", "model", "rows", 0)
    assert (sample.where((*row, "d")).line, sample.where((*row, "d")).field) == (
        9,
        "arms.arm.model.rows.0.d_mm",
    )
    assert sample.where(("arms", "arm", "payload")).field == "arms.arm.payload_g"
    missing = sample.where(("arms", "arm", "model", "frames", "x"))
    assert (missing.line, missing.field) == (6, "arms.arm.model.frames.x")
    assert sample.where(("nothing",)).file == str(sample.path)
    assert sample.where((*row[:-1], 9)).field == "arms.arm.model.rows.9"


def test_text_knows_where_it_was_written_and_survives_copies_and_dumps(sample: ConfigSource) -> None:
    text = sample.data["measurements"][0]["data"]
    assert isinstance(text, ConfigText)
    assert (text.location.line, text.base_dir, text.root) == (17, sample.path.parent, sample.root)
    for twin in (copy.copy(text), copy.deepcopy(text), pickle.loads(pickle.dumps(text))):
        assert twin == text and type(twin) is ConfigText
        assert (twin.location, twin.base_dir, twin.root) == (text.location, text.base_dir, text.root)
    assert yaml.safe_load(yaml.safe_dump(sample.data)) == sample.data
    assert "!!" not in yaml.safe_dump(sample.data) + yaml.dump(sample.data)
    assert json.loads(json.dumps(sample.data)) == sample.data


# What is refused


@pytest.mark.parametrize("text", ["", "   \n", "# only a comment\n", "---\n", "~\n", "null\n"])
def test_an_empty_file_is_refused(tmp_path: Path, text: str) -> None:
    assert "the file is empty, expected keys and values. Write at least one" in refusal(tmp_path, text)


def test_a_file_that_is_not_one_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "a: 1\n")
    os.mkfifo(tmp_path / "pipe.yaml")
    for path, says in (
        (tmp_path / "cc.yaml", f"there is no such file. Did you mean {tmp_path / 'c.yaml'}?"),
        (tmp_path / "no" / "such" / "q.yaml", "there is no such file. Check the spelling and the directory."),
        (tmp_path, "it is a directory, expected a YAML file. Give the path of the file itself."),
        (tmp_path / "pipe.yaml", "it is a device or pipe"),
        (Path("a\0b"), "it cannot be read (embedded null byte)"),
    ):
        with pytest.raises(ConfigError) as caught:
            load_config(path)
        assert str(caught.value).startswith(f"{path}: ") and says in str(caught.value)


# Extending


def test_the_child_wins_and_null_removes(tmp_path: Path) -> None:
    write(tmp_path, "a: {x: 1, y: {z: 2}, l: [1, 2]}\nb: 5\nc: 6\n", "p.yaml")
    source = load(tmp_path, "extends: p.yaml\na: {x: null, y: {w: 3}, l: [9]}\nb: {k: 1}\nn: null\n")
    assert source.data == {"a": {"y": {"z": 2, "w": 3}, "l": [9]}, "b": {"k": 1}, "c": 6, "n": None}
    assert ("a", "l", 1) not in source.marks and ("a", "x") not in source.marks


def test_later_parents_win_and_a_shared_grandparent_is_read_once(tmp_path: Path) -> None:
    write(tmp_path, "a: 0\nb: 0\nc: 0\n", "g.yaml")
    (tmp_path / "sub").mkdir()
    write(tmp_path / "sub", "extends: ../g.yaml\na: 1\nb: 1\nfile: x.csv\n", "p.yaml")
    write(tmp_path, "extends: g.yaml\nb: 2\n", "q.yaml")
    source = load(tmp_path, "extends: [sub/p.yaml, q.yaml]\n")
    assert {key: source.data[key] for key in "abc"} == {"a": 0, "b": 2, "c": 0}
    assert len(source.files) == 4
    assert resolve_path(source.data["file"]) == (tmp_path / "sub" / "x.csv").resolve()


def test_a_circle_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "a: 1\nextends: c.yaml\n", "p.yaml")
    message = refusal(tmp_path, "extends: p.yaml\n")
    assert message.startswith(f"{tmp_path / 'p.yaml'}:2, extends") and "c.yaml -> p.yaml -> c.yaml" in message
    assert "Remove one" in message
    assert "c.yaml -> c.yaml" in refusal(tmp_path, "extends: c.yaml\n")


def test_a_parent_outside_the_root_is_refused_even_through_a_link(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    outside = write(tmp_path, "a: 1\n", "out.yaml")
    (run / "link.yaml").symlink_to(outside)
    for name in ("../out.yaml", str(outside), "link.yaml"):
        message = refusal(run, f"b: 1\nextends: {name}\n")
        assert message.startswith(f"{run / 'c.yaml'}:2, extends") and "outside /" in message
        assert "Copy the file into that folder" in message


@pytest.mark.parametrize("named", ["5", "{a: b}", "[p.yaml, 3]", "[p.yaml, p.yaml]", "null"])
def test_extends_takes_file_names_only(tmp_path: Path, named: str) -> None:
    write(tmp_path, "a: 1\n", "p.yaml")
    message = refusal(tmp_path, f"extends: {named}\n")
    assert "c.yaml:1, extends" in message and "Write for example 'extends: base.yaml'" in message


def test_a_missing_or_faulty_parent_is_named_with_who_asked_for_it(tmp_path: Path) -> None:
    message = refusal(tmp_path, "a: 1\nextends: nowhere.yaml\n")
    assert "nowhere.yaml: there is no such file" in message and "c.yaml:2" in message
    write(tmp_path, "x: 1e-3\n", "p.yaml")
    assert "p.yaml:1, x" in refusal(tmp_path, "extends: p.yaml\n")


def test_an_endless_chain_of_files_is_refused(tmp_path: Path) -> None:
    for n in range(40):
        write(tmp_path, f"extends: f{n + 1}.yaml\n", f"f{n}.yaml")
    assert "more than 32 files" in refusal(tmp_path, "extends: f0.yaml\n")


# Overrides


def test_overrides_set_replace_create_and_remove(tmp_path: Path) -> None:
    text = "a: {b: 1, k: 2}\nrows: [{d_mm: 1}, {d_mm: 2}]\narm.x: {s: 1}\n"
    source = load(
        tmp_path,
        text,
        "a.b=5 mm",
        "rows.1.d_mm=3.5",
        "new.deep.key=[1, off]",
        "a.k=null",
        '"arm.x".s=4',
        "a.t=a=b",
    )
    assert source.data == {
        "a": {"b": "5 mm", "t": "a=b"},
        "rows": [{"d_mm": 1}, {"d_mm": 3.5}],
        "arm.x": {"s": 4},
        "new": {"deep": {"key": [1, False]}},
    }
    assert str(source.where(("a", "b"))) == "command line (--set a.b), a.b"
    assert source.where(("rows", 1, "d")).file == "command line (--set rows.1.d_mm)"
    assert source.where(("rows", 0, "d")).line == 2
    assert source.marks[("a", "b")].line is None


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("a.b", ["expected a dotted name, '=' and a value", "--set parameters.bounds=none"]),
        ("=3", ["expected a dotted name"]),
        ("a.b=", ["null as the value removes"]),
        ("a..b=1", ["expected a dotted name"]),
        ("a.b.=1", ["expected a dotted name"]),
        ("a b=1", ["expected a dotted name"]),
        ("rows.7=1", ["index '7' into a list of 2 values", "from 0 to 1"]),
        ("rows.x=1", ["index 'x' into a list"]),
        ("a.b.c=1", ["holds '1', expected a mapping or a list", "Override that key itself"]),
        ("a.b=1e-3", ["a.b", "Write 1.0e-3"]),
        ("a.b=[1", ["not valid YAML"]),
        ("extends=x.yaml", ["read from files only", "Write it in the config"]),
        (".".join(["a"] * 60) + "=1", ["expected a dotted name"]),
    ],
)
def test_a_bad_override_is_refused_with_its_own_words(tmp_path: Path, override: str, says: list[str]) -> None:
    message = refusal(tmp_path, "a: {b: 1}\nrows: [1, 2]\n", override)
    assert message.startswith(f"command line (--set {override.split('=')[0]}"), message
    assert all(words in message for words in says), message


# Paths


def test_a_path_is_relative_to_its_file_and_stays_in_the_root(tmp_path: Path) -> None:
    (tmp_path / "up").symlink_to("..")
    text = "ok: data/x.csv\nup: data/../../x.csv\nlink: up/x.csv\nabs: /etc/passwd\nempty: ''\nnul: \"\\0\"\n"
    data = load(tmp_path, text).data
    assert resolve_path(data["ok"]) == tmp_path.resolve() / "data" / "x.csv"
    for line, (key, says) in enumerate(
        [
            ("up", "outside /"),
            ("link", "outside /"),
            ("abs", "outside /"),
            ("empty", "Name the file"),
        ],
        start=2,
    ):
        with pytest.raises(ConfigError, match=says) as caught:
            resolve_path(data[key])
        assert str(caught.value).startswith(f"{tmp_path / 'c.yaml'}:{line}, {key}: ")
    with pytest.raises(ConfigError, match="expected the path of a file"):
        resolve_path(data["nul"])


def test_a_path_from_the_command_line_is_relative_to_the_working_directory_and_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    data = load(tmp_path, "a: 1\n", "f=../../x.csv").data
    assert resolve_path(data["f"]) == (tmp_path.parent / "x.csv").resolve()
    assert resolve_path("y.csv") == (tmp_path / "cwd" / "y.csv").resolve()


# Everything else


def mutate(rng: random.Random, text: bytes) -> bytes:
    raw = bytearray(text)
    for _ in range(rng.randint(1, 4)):
        start, size = rng.randrange(len(raw)), rng.randint(1, 12)
        match rng.randrange(4):
            case 0:
                raw[start] ^= 1 << rng.randrange(8)
            case 1:
                del raw[start : start + size]
            case 2:
                raw[start:start] = raw[start : start + size] * rng.randint(1, 5)
            case _:
                raw[start:start] = rng.choice([b"\t", b": ", b"- ", b"*m", b"&m", b"{", b"]", b"!!x", b"1e3", b"\n"])
        raw = raw or bytearray(b" ")
    return bytes(raw)


@pytest.mark.slow
@pytest.mark.parametrize("count", [500, pytest.param(2000, marks=pytest.mark.slow)])
def test_mutated_configs_give_a_result_or_a_refusal_that_names_the_file(tmp_path: Path, count: int) -> None:
    write(tmp_path, BASE, "base.yaml")
    rng, outcomes, slowest = random.Random(20240607), {"read": 0, "refused": 0}, 0.0
    for _ in range(count):
        path = write(tmp_path, mutate(rng, SAMPLE.encode()))
        began = time.perf_counter()
        try:
            source = load_config(path)
            outcomes["read"] += 1
            assert () in source.marks
        except ConfigError as fault:
            outcomes["refused"] += 1
            assert fault.where is not None and fault.where.file and fault.where.file.startswith(str(tmp_path))
            assert fault.hint
        slowest = max(slowest, time.perf_counter() - began)
    assert slowest < 2.0
    assert min(outcomes.values()) > count // 10, outcomes
