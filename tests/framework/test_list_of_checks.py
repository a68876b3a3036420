"""The list of checks: complete, on a page, instant to list, and open to plugins."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pkgutil import resolve_name

import pytest
from armcal import Finding
from armcal.cli.main import cli
from armcal.diagnose.checks import DATA_CHECKS, EXACT, FIT_CHECKS, NOTES
from armcal.plugins import use_plugins
from armcal.testing import assert_contract
from click.testing import CliRunner

from docs.tools.checks_page import as_markdown

PLUGIN = """
from armcal import Finding, hookimpl


def named(fit):
    worst = fit.errors.calibrated_mm.max()
    return [Finding("note", f"The <largest> error is {worst:.3f} {fit.unit}.", "a fact", "Nothing.")]


def broken(fit):
    return fit.no_such_number


def text(fit):
    return ["just text"]


def few(data):
    return [Finding("warning", f"There are {len(data.dataset)} records.")]


def refusing(data):
    return [Finding("bad", "These are not for this arm.", "by name", "Give others.")]


few.before_fit = refusing.before_fit = True
named.rate = "exact"


@hookimpl
def armcal_register_checks(register):
    for name in ("named", "broken", "text", "few"):
        register(name, f"{__name__}:{name}", f"Is it {name}?")
"""


@pytest.fixture(autouse=True)
def no_plugins_afterwards() -> Iterator[None]:
    yield
    use_plugins()


SETTINGS = ("--set", "validation.folds=0", "--set", "evaluator=interpreted")


def test_each_check_is_there_once_with_its_question_rate_and_page(repository) -> None:
    checks = (*DATA_CHECKS, *FIT_CHECKS)
    assert len({check.name for check in checks}) == len(checks) > 30
    for check in checks:
        assert callable(resolve_name(f"armcal.diagnose.{check.target}")), check
        assert check.question.endswith("?") and (repository / "docs" / check.page).is_file()
        assert check.rate in (EXACT, NOTES) or re.fullmatch(r"[\d.]+ %|\d+ of [\d,]+", check.rate)


def test_the_page_is_made_of_the_list(repository) -> None:
    page = (repository / "docs" / "checks.md").read_text(encoding="utf-8")
    assert page == as_markdown(), "run: python docs/tools/checks_page.py"


def test_they_are_listed_without_numbers_being_imported(tmp_path) -> None:
    (tmp_path / "mine.py").write_text(PLUGIN, encoding="utf-8")
    script = "import sys; sys.argv = ['armcal', *sys.argv[1:]]; from armcal.cli.main import main\n"
    script += "try: main()\nfinally: print('heavy', [m for m in ('numpy', 'casadi') if m in sys.modules])"
    run = [sys.executable, "-c", script, "--plugin", str(tmp_path / "mine.py"), "checks"]
    listed = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    assert "heavy []" in listed
    for words in ("Did the solver", "named", "Is it named?", "few"):
        assert words in listed
    names = json.loads(CliRunner().invoke(cli, ["checks", "--json"]).stdout)["checks"]
    assert [own["name"] for own in names] == [own.name for own in (*DATA_CHECKS, *FIT_CHECKS)]


@pytest.mark.slow
def test_a_plugins_checks_are_in_verdict_and_report_and_a_broken_one_is_a_warning(repository, tmp_path) -> None:
    (tmp_path / "mine.py").write_text(PLUGIN, encoding="utf-8")
    demo, out = str(repository / "configs" / "lrm_arm" / "demo.yaml"), tmp_path / "out"
    plugin = ("--plugin", str(tmp_path / "mine.py"))
    ran = CliRunner().invoke(cli, ["run", demo, "--out", str(out), "--json", *SETTINGS, *plugin])
    assert ran.exit_code == 0, ran.output
    content = json.loads(ran.stdout)
    texts = {finding["text"]: finding["grade"] for finding in content["verdict"]["findings"]}
    (said,) = (text for text in texts if text.startswith("The <largest> error"))
    assert texts[said] == "note" and texts["There are 200 records."] == "warning"
    for fault in (
        "'text' of the plugin mine failed: TypeError: found ['just text'], expected a list of",
        "'broken' of the plugin mine failed: AttributeError",
    ):
        assert any(text.startswith(f"The check {fault}") and texts[text] == "warning" for text in texts)
    assert "There are 200 records." not in content["warnings"], "a finding is not said twice"
    page = (out / "report.html").read_text(encoding="utf-8").replace("\xa0", " ")
    assert said.replace("<", "&lt;").replace(">", "&gt;") in page


def test_data_that_a_plugins_check_calls_bad_are_refused(repository, tmp_path) -> None:
    (tmp_path / "mine.py").write_text(PLUGIN.replace('"few")', '"refusing")'), encoding="utf-8")
    demo = str(repository / "configs" / "lrm_arm" / "demo.yaml")
    ran = CliRunner().invoke(cli, ["run", demo, *SETTINGS, "--plugin", str(tmp_path / "mine.py")])
    assert ran.exit_code == 2 and "These are not for this arm. Give others." in " ".join(ran.stderr.split())


def test_the_contract_asks_a_check_of_a_sound_fit() -> None:
    def sound(fit):
        return [] if fit.converged and fit.errors.calibrated_mm.max() < 1e-6 else [Finding("warning", "not sound")]

    assert_contract(sound, "check")
    for wrong, words in (
        (lambda fit: None, "found None, expected a list"),
        (lambda fit: [Finding("bad", "x")], "found"),
    ):
        with pytest.raises(AssertionError, match=words):
            assert_contract(wrong, "check")
