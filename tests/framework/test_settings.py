"""Settings: units, strict types, round trips, and every fault of a config at its own line."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.base.settings import (
    Fault,
    Length,
    Settings,
    UnitOf,
)
from armcal.config.validate import validate
from pydantic import ValidationError
from settings_samples import GOOD, Experiment, Mdh, Row, Side, check, load


def faults(settings_class: type[Settings], values: dict[str, Any]) -> dict[tuple[str | int, ...], str]:
    with pytest.raises(ValidationError) as caught:
        settings_class.model_validate(values)
    found = {}
    for error in caught.value.errors():
        found[error["loc"]] = error["input"].message if isinstance(error["input"], Fault) else error["msg"]
    return found


# Units


def test_a_config_is_read_into_si(tmp_path: Path) -> None:
    made = check(tmp_path, GOOD)
    assert isinstance(made.model, Mdh)
    assert made.model.rows == (
        Row.si(name="shoulder", d=0.0469, theta=math.radians(60)),
        Row.si(com=(0.0, 0.002, 0.03)),
    )
    assert (made.noise, made.payload, made.bounds, made.side) == (0.0005, 0.05, False, Side.RIGHT)
    assert made.compliance == {"j1": 0.05, "j2": math.radians(1)}
    assert made.data == (tmp_path / "poses.csv").resolve()
    assert type(made.model.rows[0].name) is str


@pytest.mark.parametrize(
    "entry", [{"d_mm": 50}, {"d_m": 0.05}, {"d": "50 mm"}, {"d_mm": "5 cm"}, {"d_cm": 5.0}, {"d": "5cm"}]
)
def test_every_spelling_of_a_length_is_the_same_length(entry: dict[str, Any]) -> None:
    assert Row.model_validate(entry).d == 0.05


@pytest.mark.parametrize(
    ("entry", "field", "says"),
    [
        ({"d": 46.9}, ("d",), ["found 46.9 with its unit missing", "write d_mm: 46.9 or d: 46.9 mm"]),
        ({"com": [0, 2, 3]}, ("com",), ["unit missing", "write com_mm: [0, 2, 3]"]),
        ({"d_deg": 3}, ("d",), ["found d_deg (angle), expected length", "d_m or d_cm or d_mm or d_um"]),
        ({"d_mm": "5 deg"}, ("d",), ["'5 deg' has a unit of angle", "m, cm, mm, um", "d_mm"]),
        ({"d_mm": 1, "d_m": 2}, ("d",), ["found both d_mm and d_m", "remove the other"]),
        ({"d": "1 m", "d_m": 2}, ("d",), ["found both d and d_m"]),
        ({"d_mm": "long"}, ("d",), ["'long' is not a number with a unit"]),
        ({"d_mm": "5"}, ("d",), ["'5' has no unit"]),
        ({"d": "1,5 mm"}, ("d",), ["decimal comma"]),
        ({"com_mm": [0, "x", 3]}, ("com", 1), ["'x' is not a number"]),
        ({"d_mm": 10**400}, ("d",), ["too large"]),
        ({"theta_furlong": 3}, ("theta_furlong",), ["unknown key 'theta_furlong'"]),
        ({"d_nm": 3}, ("d_nm",), ["did you mean d_"]),
        ({"nam": "x"}, ("nam",), ["did you mean name?"]),
        ({"zzz": 3}, ("zzz",), ["expected one of name, d_mm, theta_deg, com_mm"]),
    ],
)
def test_a_refused_quantity_names_its_field_and_the_keys_to_write(
    entry: dict[str, Any], field: tuple[str | int, ...], says: list[str]
) -> None:
    found = faults(Row, entry)
    assert list(found) == [field]
    assert all(words in found[field] for words in says), found


def test_booleans_are_no_quantities() -> None:
    assert set(faults(Row, {"d_mm": True, "com_mm": [True, 0, 0]})) == {("d",), ("com", 0)}


def test_a_required_quantity_that_is_missing_says_how_to_write_it() -> None:
    found = faults(Experiment, {"model": {"type": "poe", "axes": []}})
    assert "write noise_mm: ... or noise: ... mm" in found[("noise",)]


def test_text_stays_text_where_a_quantity_may_also_be_a_word() -> None:
    base = {"model": {"type": "poe", "axes_m": []}, "noise_mm": 1}
    assert Experiment.model_validate({**base, "bounds": "auto"}).bounds == "auto"
    assert Experiment.model_validate({**base, "bounds": "5 deg"}).bounds == math.radians(5)
    found = faults(Experiment, {**base, "bounds": "5 mm"})
    assert any("'5 mm' has a unit of length" in message for message in found.values())


def test_python_builds_from_si_numbers_nested_and_from_arrays() -> None:
    assert Row.si(d=0.0469).d == 0.0469
    assert Row.si(d=1, com=np.array([1.0, 2.0, 3.0])).com == (1.0, 2.0, 3.0)
    mdh = Mdh.si(type="mdh", rows=[{"d": 0.5}, Row.si(d=0.25)])
    assert [row.d for row in mdh.rows] == [0.5, 0.25]
    assert Mdh.model_validate(mdh) is mdh
    with pytest.raises(ValidationError):
        Row(d=0.0469)
    with pytest.raises(ValidationError):
        Row.si(d="far")
    with pytest.raises(ValidationError):
        Row.si(d=math.nan)
    assert Row().com == (0.0, 0.0, 0.0) and type(Row().com[0]) is float


def test_settings_are_frozen() -> None:
    with pytest.raises(ValidationError):
        Row().d = 1.0


def test_a_dimensionless_or_unknown_dimension_is_a_mistake_of_the_author() -> None:
    with pytest.raises(ValueError, match="plain float"):
        UnitOf("dimensionless")
    with pytest.raises(ValueError, match="'size' is not known"):
        UnitOf("size")


def test_a_quantity_beside_a_nested_model_leaves_the_model_its_own_units() -> None:
    class Noise(Settings):
        noise: Length | Row = 0.0

    nested = Noise.model_validate({"noise": {"d_mm": 3}})
    assert nested.noise == Row.si(d=0.003)
    assert Noise.model_validate(nested.to_config()) == nested
    assert Noise.model_validate({"noise_mm": 3}).noise == 0.003


# Strict types


@pytest.mark.parametrize(
    ("key", "refused", "accepted"),
    [
        ("weight", ["1", True, None, "1.0", [1]], 2),
        ("config", ["1", True], 2),
        ("default", ["1", True, 1.0], 2),
        ("folds", ["1", True, 1.0, 1.5], 3),
        ("strict", ["yes", 1, 0, "true"], False),
        ("side", ["up", 1, True], "right"),
        ("weight", [math.inf, math.nan], 0.5),
        ("gravity_m_s2", [[0, 0], [0, 0, 0, 0], "x", {"a": 1}], [0, 0, 1]),
    ],
)
def test_nothing_is_converted_silently(key: str, refused: list[Any], accepted: Any) -> None:
    base = {"model": {"type": "poe", "axes_m": []}, "noise_mm": 1}
    Experiment.model_validate({**base, key: accepted})
    for value in refused:
        with pytest.raises(ValidationError):
            Experiment.model_validate({**base, key: value})


# There and back


def test_settings_written_as_config_come_back_bit_for_bit(tmp_path: Path) -> None:
    made = check(tmp_path, GOOD)
    config = made.to_config()
    assert config["noise_m"] == 0.0005 and config["model"]["rows"][0]["d_m"] == 0.0469
    assert config["bounds"] is False and config["compliance_rad_per_Nm"]["j1"] == 0.05
    again = validate(Experiment, load(tmp_path, yaml.safe_dump(config)))
    assert again == made and again.to_config() == config


def test_random_settings_come_back_bit_for_bit() -> None:
    rng = random.Random(1)
    for _ in range(300):
        rows = [Row.si(d=rng.gauss(0, 1), theta=rng.choice([None, rng.gauss(0, 3)])) for _ in range(3)]
        compliance = {"j": rng.expovariate(1)}
        made = Experiment.si(model=Mdh.si(type="mdh", rows=rows), noise=rng.random(), compliance=compliance)
        assert Experiment.model_validate(made.to_config()) == made


def test_the_keys_of_settings_are_listed_as_a_config_writes_them() -> None:
    assert Row.keys() == ("name", "d_mm", "theta_deg", "com_mm")
    assert Row.quantities() == {"d": "length", "theta": "angle", "com": "length"}


def test_a_model_that_holds_itself_is_strict_at_every_depth() -> None:
    found = faults(Tree, {"kids": [{"kids": [{"weight": "1", "d": 3}]}]})
    assert set(found) == {("kids", 0, "kids", 0, "weight"), ("kids", 0, "kids", 0, "d")}


class Tree(Settings):
    weight: float = 1.0
    d: Length = 0.0
    kids: tuple[Tree, ...] = ()
