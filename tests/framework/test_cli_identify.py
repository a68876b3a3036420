"""``armcal identify`` and ``armcal check`` as a user meets them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from armcal.cli.main import cli
from click.testing import CliRunner, Result

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "lrm_arm"
DEMO, ALL, DATA = str(CONFIGS / "demo.yaml"), str(CONFIGS / "all_45.yaml"), str(CONFIGS / "demo.csv")
OPTION_1 = yaml.safe_load((CONFIGS / "option1.yaml").read_text())["parameters"]["free"]
PREFER = [word for glob in OPTION_1 for word in ("--prefer", glob)]
FAST = ["--set", "evaluator=interpreted"]


def armcal(*arguments: str) -> Result:
    return CliRunner().invoke(cli, [*arguments, *FAST])


def asked(*arguments: str) -> dict:
    result = armcal("identify", *arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def free(*globs: str) -> str:
    return f"parameters.free={json.dumps(globs)}"


def test_a_sound_set_is_told_to_be_sound() -> None:
    told = asked(DEMO)
    assert told["rank"] == told["rank_by_qr"] == len(told["free"]) == 28
    assert told["undetermined"] == [] and {*told["determined_by"].values()} == {"data"}
    assert told["equations"] == 450 and told["records"] == 150
    indices, values = told["observability_of_the_determined"], told["singular_values"]
    assert indices["o2"] == pytest.approx(1 / told["scaled_condition"]) == pytest.approx(values[-1] / values[0])
    assert indices["o3"] == pytest.approx(values[-1])
    pairs = {frozenset((c["one"], c["other"])) for c in told["correlated"]}
    assert frozenset(("arm.mdh.a4", "arm.mdh.theta4")) in pairs
    assert all(abs(c["correlation"]) > 0.95 for c in told["correlated"])
    assert "minimal" not in told


@pytest.mark.slow
def test_45_parameters_reduce_to_34_of_which_the_published_28_are_part() -> None:
    told = asked(ALL, "--data", DATA, "--minimal", *PREFER)
    assert (len(told["free"]), told["rank"], len(told["undetermined"])) == (45, 34, 11)
    minimal = told["minimal"]
    assert len(minimal["kept"]) == 34 and len(minimal["redundant"]) == 11
    published = asked(str(CONFIGS / "option1.yaml"), "--data", DATA)["free"]
    assert set(published) < set(minimal["kept"])
    asked_for = asked(ALL, "--data", DATA, *PREFER, "--most", "28")["minimal"]
    assert set(asked_for["kept"]) == set(published) and len(asked_for["left_out"]) == 6


@pytest.mark.slow
def test_the_printed_block_is_a_configuration_that_can_be_solved(tmp_path: Path) -> None:
    result = armcal("identify", ALL, "--data", DATA, "--minimal")
    block = result.stdout[result.stdout.index("parameters:\n") :]
    chosen = yaml.safe_load(block)["parameters"]["free"]
    assert len(chosen) == 34
    assert armcal("check", ALL, "--data", DATA).exit_code == 2
    done = armcal("check", ALL, "--data", DATA, "--set", free(*chosen))
    assert done.exit_code == 0, done.output
    assert "rank 34 of 34" in done.stdout


@pytest.mark.slow
def test_gauge_poses_and_values_are_told_apart_in_words() -> None:
    names = ("arm.mdh.alpha6", "arm.mdh.tool_rx", "arm.mdh.after2_z", "arm.mdh.d3", "arm.spring.k?")
    result = armcal("identify", ALL, "--data", DATA, "--set", free(*names))
    assert result.exit_code == 0
    text = result.stdout
    gauge = text[text.index("no poses determine it (1):") : text.index("only away from them (1):")]
    assert "arm.mdh.alpha6 trades with arm.mdh.tool_rx (+1 deg with -1 deg)" in gauge
    assert "arm.mdh.after2_z trades with arm.mdh.d3 (+1 mm with -1 mm)" in text[text.index("only away") :]
    assert "undetermined: arm.mdh.after2_z, arm.mdh.d3, " in text and "; armcal run refuses them." in text


@pytest.mark.slow
def test_poses_that_do_not_tell_are_told_from_poses_that_cannot(tmp_path: Path) -> None:
    lines = [line.split(",") for line in Path(DATA).read_text().splitlines()]
    column = lines[0].index("q6_deg")
    for line in lines[1:]:
        line[column] = "30.0"
    still = tmp_path / "still.csv"
    still.write_text("\n".join(",".join(line) for line in lines) + "\n")
    names = free("arm.mdh.theta6", "arm.mdh.d6", "arm.mdh.tool_y", "arm.mdh.a6", "arm.mdh.tool_z", "arm.mdh.alpha5")
    causes = {c["cause"] for c in asked(ALL, "--data", str(still), "--set", names)["undetermined"]}
    assert "poses" in causes and "gauge" in causes
    moved = asked(ALL, "--data", DATA, "--set", names)["undetermined"]
    assert "poses" not in {c["cause"] for c in moved}


@pytest.mark.slow
def test_a_gauge_that_priors_hold_is_said_and_can_be_run(tmp_path: Path) -> None:
    flags = ["--set", free("arm.mdh.d6", "arm.mdh.tool_y", "arm.mdh.theta2"), "--set"]
    flags.append('parameters.priors={"arm.mdh.d6": 1 mm}')
    result = armcal("identify", ALL, "--data", DATA, *flags)
    assert "The data determines 1 of 3 free parameters; held by priors: arm.mdh.d6, arm.mdh.tool_y." in result.stdout
    told = asked(ALL, "--data", DATA, *flags)
    assert told["determined_by"] == {"arm.mdh.theta2": "data", "arm.mdh.d6": "prior", "arm.mdh.tool_y": "prior"}
    assert told["expected_sd"]["arm.mdh.d6"] == pytest.approx(0.001, rel=1e-3)
    done = armcal("check", ALL, "--data", DATA, *flags)
    assert done.exit_code == 0 and "1 of 3 free parameters; held by priors: arm.mdh.d6, arm.mdh.tool_y" in done.stdout


def test_what_stays_uncertain_is_left_out_when_asked() -> None:
    minimal = asked(DEMO, "--max-sd", "0.1")["minimal"]
    assert {d["name"] for d in minimal["left_out"]} == {"arm.spring.k5", "arm.spring.k6"}
    assert max(minimal["sd_ordinary_sizes"].values()) <= 0.1


@pytest.mark.quick("--data-nowhere.csv", "--max-sd---max-sd", "--most---most", "--prefer-none of the parameters")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--prefer", "arm.mdh.thata3"], ["arm.mdh.thata3", "arm.mdh.theta3"]),
        (["--prefer", "arm.links.*"], ["none of the parameters", "parameters.free"]),
        (["--set", "parameters.free=[]"], ["no parameter is free"]),
        (["--most", "-1"], ["--most"]),
        (["--max-sd", "0"], ["--max-sd"]),
        (["--data", "nowhere.csv"], ["nowhere.csv"]),
    ],
    ids=lambda value: str(value[0]),
)
def test_bad_input_is_refused_in_words(arguments: list[str], words: list[str]) -> None:
    result = armcal("identify", DEMO, *arguments)
    assert result.exit_code == 2 and not isinstance(result.exception, AssertionError)
    assert "Traceback" not in result.output
    for word in words:
        assert word in result.output


@pytest.mark.slow
def test_quiet_prints_nothing_and_verbose_prints_every_deviation() -> None:
    assert armcal("identify", DEMO, "-q").stdout == ""
    verbose = armcal("identify", DEMO, "-v").stdout
    assert len(re.findall(r"^  arm\.[a-z0-9_.]+: [0-9.e-]+, determined by the data$", verbose, re.MULTILINE)) == 28


@pytest.mark.slow
def test_few_records_are_no_reason_to_refuse(tmp_path: Path) -> None:
    few = tmp_path / "few.csv"
    few.write_text("\n".join(Path(DATA).read_text().splitlines()[:6]) + "\n")
    told = asked(ALL, "--data", str(few))
    assert told["rank"] == told["equations"] == 15
    assert {c["cause"] for c in told["undetermined"]} >= {"gauge", "poses"}


# ---------------------------------------------------------------- check


def test_check_shows_the_excitation_before_it_refuses() -> None:
    result = armcal("check", ALL, "--data", DATA)
    assert result.exit_code == 2
    assert "Excitation of the joints" in result.stdout and "rank 34 of 45" in result.stdout
    assert re.search(r"arm\.q1 +-100 +100 +deg +3 ", result.stdout)
    assert "Ready to run" not in result.stdout
    assert "does not determine 11 combinations" in result.stderr and "armcal identify" in result.stderr
    told = json.loads(armcal("check", ALL, "--data", DATA, "--json").stdout)
    assert told["error"]["exit_code"] == 2 and told["excitation_rad_or_m"]["arm.q1"]["levels"] == 3


@pytest.mark.parametrize("command", ["check", "run"])
def test_more_folds_than_records_are_refused_before_anything_is_fitted(command: str, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "run")] if command == "run" else []
    result = armcal(command, DEMO, "--set", "validation.folds=151", *out)
    assert result.exit_code == 2
    assert "151 folds of 150 records" in result.output
    assert not (tmp_path / "run").exists()


def test_holding_every_record_out_is_refused(tmp_path: Path) -> None:
    few = tmp_path / "few.csv"
    few.write_text("\n".join(Path(DATA).read_text().splitlines()[:4]) + "\n")
    flags = ["--set", "validation.holdout=0.9", "--set", "validation.folds=0"]
    result = armcal("check", DEMO, "--data", str(few), *flags)
    assert result.exit_code == 2 and "no record is left to train on" in result.output


@pytest.mark.slow
def test_the_real_arm(shared_data: Path) -> None:
    """313 real poses: the same counts as for the simulated arm."""
    told = asked(ALL, "--data", str(shared_data / "lrm_arm" / "poses.csv"), "--minimal", *PREFER)
    assert told["rank"] == len(told["minimal"]["kept"]) == 34
    assert [c["cause"] for c in told["undetermined"]].count("gauge") == 5
