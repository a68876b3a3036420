"""Settings checked against the config they came from: every fault once, at its own line, with its mend."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Annotated, Literal

import pytest
from armcal.base.settings import Length, Settings
from armcal.config.validate import validate
from armcal.errors import ConfigError
from pydantic import Field, model_validator
from settings_samples import GOOD, Experiment, Mdh, Poe, Row, check, load


def refusal(folder: Path, text: str, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        check(folder, text, *overrides)
    return str(caught.value).replace(str(folder), "")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("d_mm: 46.9", "d: 46.9", ["c.yaml:5, model.rows.0.d: found 46.9", "write d_mm: 46.9"]),
        (
            "d_mm: 46.9",
            "d_deg: 46.9",
            ["c.yaml:5, model.rows.0.d_deg: found d_deg (angle), expected length"],
        ),
        (
            "d_mm: 46.9",
            "dmm: 46.9",
            ["c.yaml:5, model.rows.0.dmm: ", "unknown key 'dmm': did you mean d_mm?"],
        ),
        ("3 cm]", "3 deg]", ["c.yaml:7, model.rows.1.com_mm.2: '3 deg' has a unit of angle"]),
        ("3 cm]", "3 cm, 4]", ["c.yaml:7, model.rows.1.com_mm: ", "at most 3"]),
        (
            ", 3 cm]",
            "]",
            ["c.yaml:7, model.rows.1.com_mm: found a list of 2 values, expected at least 3: add"],
        ),
        (
            "noise_mm: 0.5",
            "noise_mm: -0.5",
            ["c.yaml:8, noise_mm: found -0.5 (-0.0005 in SI units)", "greater than 0"],
        ),
        ("noise_mm: 0.5\n", "", ["c.yaml:1, noise: found nothing, expected length: write noise_mm"]),
        (
            "noise_mm",
            "nosie_mm",
            ["c.yaml:8, nosie_mm: ", "did you mean noise_mm?", "Correct these 2 places"],
        ),
        (
            "payload_g: 50",
            "weight: '5'",
            ["c.yaml:10, weight: found the text '5', expected a number: write it"],
        ),
        ("payload_g: 50", "folds: 5.0", ["c.yaml:10, folds: found 5.0, expected a whole number"]),
        ("payload_g: 50", "strict: 1", ["c.yaml:10, strict: found 1, expected true or false"]),
        (
            "payload_g: 50",
            "zzz: 1",
            ["c.yaml:10, zzz: ", "unknown key 'zzz', expected one of model, noise_mm,"],
        ),
        ("side: right", "side: rigth", ["c.yaml:11, side: found the text 'rigth'", "did you mean right?"]),
        ("bounds: off", "bounds: 5", ["c.yaml:13, bounds: found 5 with its unit missing", "bounds_deg: 5"]),
        (
            "bounds: off",
            "bounds: atuo",
            ["c.yaml:13, bounds: found the text 'atuo', expected a number or 'auto' or true"],
        ),
        ("type: mdh", "type: mhd", ["c.yaml:1, model: found the 'type' 'mhd'", "did you mean mdh?"]),
        ("  type: mdh\n", "", ["c.yaml:1, model: found nothing, expected the key 'type'"]),
        (
            "name: shoulder",
            "name: 5",
            ["c.yaml:4, model.rows.0.name: found 5, expected text: put it in double"],
        ),
        (
            "data: poses.csv",
            "data: ../x.csv",
            ["c.yaml:12, data: the path '../x.csv' leads to", "Copy the file into that folder"],
        ),
        ("payload_g: 50", "payload: [1]", ["c.yaml:10, payload: found [1] with its unit missing"]),
        ("{j1: 0.05,", "{j1: x,", ["c.yaml:9, compliance_rad_per_Nm.j1: 'x' is not a number"]),
    ],
)
def test_a_fault_is_reported_once_at_its_line_with_its_mend(
    tmp_path: Path, old: str, new: str, says: list[str]
) -> None:
    assert GOOD.count(old) == 1
    message = refusal(tmp_path, GOOD.replace(old, new))
    assert all(words in message for words in says), message
    assert message.count("c.yaml:") == (2 if "nosie" in new else 1), message


def test_all_faults_are_reported_together_in_the_order_of_their_lines(tmp_path: Path) -> None:
    text = GOOD.replace("d_mm: 46.9", "d: 1").replace("payload_g: 50", "folds: x").replace("off", "wild")
    with pytest.raises(ConfigError) as caught:
        check(tmp_path, text)
    lines = str(caught.value).splitlines()
    places = ["c.yaml:5, model.rows.0.d:", "c.yaml:10, folds:", "c.yaml:13, bounds:"]
    assert [place in line for place, line in zip(places, lines, strict=False)] == [True] * 3
    assert lines[3:] == ["Correct these 3 places."]
    assert caught.value.where is not None and caught.value.where.line == 5


def test_a_fault_from_the_command_line_is_placed_there(tmp_path: Path) -> None:
    message = refusal(tmp_path, GOOD, "model.rows.1.d=5")
    assert message.startswith("command line (--set model.rows.1.d), model.rows.1.d: found 5 with its unit missing")


def test_a_part_below_a_path_keeps_its_full_place(tmp_path: Path) -> None:
    source = load(tmp_path, GOOD.replace("d_mm: 46.9", "d_mm: true"))
    with pytest.raises(ConfigError, match=r"c\.yaml:5, model\.rows\.0\.d_mm: found true, expected a number"):
        validate(Row, source, ("model", "rows", 0))
    assert validate(Row, source, ("model", "rows", 1)).com == (0.0, 0.002, 0.03)
    with pytest.raises(ConfigError, match=r"c\.yaml:1, arm\.row: found no 'arm\.row'.*d_mm"):
        validate(Row, source, ("arm", "row"))
    with pytest.raises(ConfigError, match=r"c\.yaml:3, model\.rows: found a list of 2 values, expected keys and"):
        validate(Row, source, ("model", "rows"))


def test_of_a_union_only_the_members_that_have_the_shape_of_the_value_are_reported(tmp_path: Path) -> None:
    class Holder(Settings):
        part: Annotated[Mdh | Poe, Field(discriminator="type")] | Length
        joints: Literal["all"] | tuple[str, ...]

    text = "part:\n  type: poe\n  axes_mm: [[0, 0, 1]]\n  rows: []\njoints: [q1, 2]\n"
    with pytest.raises(ConfigError) as caught:
        validate(Holder, load(tmp_path, text))
    first, second, _ = str(caught.value).splitlines()
    assert first.startswith(f"{tmp_path / 'c.yaml'}:4, part.rows: found the unknown key 'rows'")
    assert second.startswith(f"{tmp_path / 'c.yaml'}:5, joints.1: found 2, expected text")


def test_a_check_of_the_plugin_itself_is_placed_at_its_part(tmp_path: Path) -> None:
    class Range(Settings):
        low: float
        high: float

        @model_validator(mode="after")
        def _ordered(self) -> Range:
            if self.low >= self.high:
                raise ValueError(f"low {self.low} is not below high {self.high}: exchange them.")
            return self

    class Holder(Settings):
        span: Range

    with pytest.raises(ConfigError, match=r"c\.yaml:2, span: low 2\.0 is not below high 1\.0: exchange them\.$"):
        validate(Holder, load(tmp_path, "# a range\nspan: {low: 2.0, high: 1}\n"))


@pytest.mark.slow
def test_two_thousand_mutated_configs_give_settings_or_a_refusal(tmp_path: Path) -> None:
    rng, refused = random.Random(7), 0
    for _ in range(2000):
        text = list(GOOD)
        for _ in range(rng.randint(1, 3)):
            start, size = rng.randrange(len(text)), rng.randint(1, 8)
            match rng.randrange(3):
                case 0:
                    text[start] = chr(rng.randrange(32, 127))
                case 1:
                    del text[start : start + size]
                case _:
                    text[start:start] = text[start : start + size] * 2
        try:
            assert isinstance(check(tmp_path, "".join(text)), Experiment)
        except ConfigError as fault:
            refused += 1
            assert fault.where is not None and "c.yaml" in str(fault.where)
    assert 400 < refused < 1990, refused
