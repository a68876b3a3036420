"""The strict YAML reader: which scalars it reads, and what it refuses at which line with which mend."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from armcal.base.config_text import ConfigText
from armcal.config import yaml_source
from armcal.config.yaml_source import ConfigSource, Origin, load_config, read_nodes
from armcal.errors import ConfigError

SAMPLE = """\
# an arm with two rows
unit: mm
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


def write(folder: Path, text: str | bytes, name: str = "c.yaml") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def load(folder: Path, text: str | bytes) -> ConfigSource:
    return load_config(write(folder, text))


def refusal(folder: Path, text: str | bytes) -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, text)
    assert caught.value.exit_code == 2
    return str(caught.value)


@pytest.mark.parametrize("loader", [yaml.SafeLoader, getattr(yaml, "CSafeLoader", yaml.SafeLoader)])
def test_both_parsers_of_yaml_read_the_sample_alike_and_as_safe_load_does(loader: Any, tmp_path: Path) -> None:
    def flat(node: Any) -> Any:
        if isinstance(node.value, dict):
            return {key: flat(entry) for key, entry in node.value.items()}
        return [flat(entry) for entry in node.value] if isinstance(node.value, tuple) else node.value

    node = read_nodes(SAMPLE, Origin("c.yaml", tmp_path), loader)
    assert node is not None and isinstance(node.value, dict)
    assert flat(node) == yaml.safe_load(SAMPLE)
    assert [entry.line for entry in node.value.values()] == [2, 3, 4, 14, 18, 19]


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("yes", True),
        ("off", False),
        ("True", True),
        ("NO", False),
        ("~", None),
        ("", None),
        ("null", None),
        ("0", 0),
        ("-12", -12),
        ("0x40", 64),
        ("1.0e-3", 0.001),
        ("-.5", -0.5),
        ("3.", 3.0),
        ("y", "y"),
        ("2024-01-01", "2024-01-01"),
        ('"1e-3"', "1e-3"),
        ("'010'", "010"),
        ("!!str 010", "010"),
        ("5 mm", "5 mm"),
        ("1e-3 m", "1e-3 m"),
        ("a: b".replace(": ", ":"), "a:b"),
    ],
)
def test_a_scalar_is_read(tmp_path: Path, written: str, value: object) -> None:
    found = load(tmp_path, f"a: {written}\n").data["a"]
    assert found == value
    assert type(found) is (ConfigText if isinstance(value, str) else type(value))


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path: Path) -> None:
    source = load(tmp_path, b"\xef\xbb\xbfa: 1\r\nb: x\r\n")
    assert source.data == {"a": 1, "b": "x"}
    assert source.where(("b",)).line == 2


DEEP = "a: " + "[" * 51 + "]" * 51
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 9)
)


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("a:\n\tb: 1\n", 2, ["indented with a tab", "Replace the tab by spaces"]),
        ("a:\n  b: 1\n  c: 2\n  b: 3\n", 4, ["a.b", "'b' stands here and at line 2", "Remove or rename"]),
        ("- 1\n- 2\n", 1, ["found a list at the top", "Write 'key: value' lines"]),
        ("just text\n", 1, ["'just text'", "put a space after each colon"]),
        ("a: 1\nb: 1e-3\n", 2, [", b:", "1e-3 is text to YAML", 'Write 1.0e-3, or "1e-3"']),
        ("a: 1.5E6\n", 1, [", a:", "Write 1.5e+6"]),
        ("a: .5e3\n", 1, [", a:", "Write 0.5e+3"]),
        ("x:\n  a: 12:30\n", 2, ["x.a", "base 60", 'for example 90 s, or "12:30"']),
        ("a: 010\n", 1, [", a:", "octal", 'Write 10, or "010"']),
        ("a: -010\n", 1, [", a:", "octal", "Write -10"]),
        ("a: 0o10\n", 1, [", a:", "octal", "Write a decimal number"]),
        ("a: 0b11\n", 1, [", a:", "binary", "Write a decimal number"]),
        ("a: 1_000\n", 1, [", a:", "underscores", "Write 1000"]),
        ("a: [1, .nan]\n", 1, ["a.1", "not a finite number", "Write a finite number"]),
        ("a: -.inf\n", 1, [", a:", "not a finite number"]),
        ("a: 1.0e+999\n", 1, [", a:", "too large", "Write a finite number"]),
        (f"a: {'9' * 400}\n", 1, [", a:", "400 digits"]),
        ("on: 1\n", 1, ["'on' is read as the bool True", 'Quote it: "on"']),
        ("1: 1\n", 1, ["'1' is read as the int 1", 'Quote it: "1"']),
        ("~: 1\n", 1, ["is read as nothing"]),
        ("a: 1\n12:30: 1\n", 2, ["the key 12:30", 'Quote it: "12:30"']),
        ("? [a, b]\n: 1\n", 1, ["as a key", "Write a plain name"]),
        ('"": 1\n', 1, ["empty key"]),
        ("a: 1\n---\nb: 1\n", 2, ["a second document", "Remove the line '---'"]),
        ("a: !!python/object/apply:os.system ['ls']\n", 1, ["!!python/object/apply:os.system", "Remove it"]),
        ("a: !!float 1\n", 1, [", a:", "!!float", "Remove it"]),
        ("a: !mine {b: 1}\n", 1, [", a:", "!mine", "Remove it"]),
        ("b: &b {c: 1}\na:\n  <<: *b\n", 3, [", a:", "merge keys", "'extends'"]),
        ("a: *nowhere\n", 1, [", a:", "*nowhere names no anchor", "Write &nowhere"]),
        ("a: &a [1, *a]\n", 1, ["a.1", "inside what it names", "Write the value out"]),
        (BOMB, 6, ["more than 1000000 values", "CSV"]),
        (f"b: 1\n{DEEP}\n", 2, ["deeper than 50 levels", "Flatten"]),
        ("a: " + "- " * 5 + "1\n", 1, ["not valid YAML"]),
        ("a:\n  " + "- " * 200_000 + "1\n", 2, ["deeper than 50 levels"]),
        ("a: [1, 2\nb: 3\n", 2, ["not valid YAML", "brackets"]),
        ("a: 'x\n", 2, ["not valid YAML", "quotes"]),
        ("a: @x\n", 1, ["not valid YAML"]),
        ("a: 1\nb: \x07\n", 2, ["control character U+0007", "Delete it"]),
        (b"a: 1\nb: caf\xe9\n", 2, ["0xe9 at offset 11", "Save the file as UTF-8"]),
        ("a: 1\n".encode("utf-16"), 1, ["0xff at offset 0", "UTF-8"]),
    ],
)
def test_a_refusal_names_file_line_field_and_mend(
    tmp_path: Path, text: str | bytes, line: int, says: list[str]
) -> None:
    message = refusal(tmp_path, text)
    assert message.startswith(f"{tmp_path / 'c.yaml'}:{line}"), message
    assert all(words in message for words in says), message


@pytest.mark.slow
def test_a_file_over_sixteen_mebibytes_is_refused_and_one_at_the_limit_is_read(tmp_path: Path) -> None:
    body = b"a: 1\n#"
    assert load(tmp_path, body + b"x" * ((16 << 20) - len(body))).data == {"a": 1}
    message = refusal(tmp_path, body + b"x" * ((16 << 20) - len(body) + 1))
    assert "larger than 16 MiB, expected a YAML file. Check the path" in message


@pytest.mark.slow
def test_fifty_levels_are_read_and_values_up_to_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load(tmp_path, "a: " + "[" * 49 + "]" * 49).data["a"] is not None
    assert yaml_source.MAX_NODES == 1_000_000
    monkeypatch.setattr(yaml_source, "MAX_NODES", 100_000)
    assert len(load(tmp_path, f"a: [{'1,' * 99_990}]").data["a"]) == 99_990
    assert "more than 100000 values" in refusal(tmp_path, f"a: [{'1,' * 100_000}]")


def test_depth_is_counted_through_aliases(tmp_path: Path) -> None:
    lines = ["l0: &l0 [1]"] + [f"l{n}: &l{n} [*l{n - 1}]" for n in range(1, 60)]
    message = refusal(tmp_path, "\n".join(lines))
    assert "deeper than 50 levels" in message and "c.yaml:50" in message
