"""Faults planted in components and plugins, one at a time: the contract's checks find each, and nothing in its twin."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest
from armcal.hooks import KINDS
from armcal.plugins import Component, PluginRegistry, discover
from armcal.testing import assert_contract
from armcal.testing.checking import CHECKS
from armcal.testing.contract import CheckResult, check_component, check_plugin, checks_of

PLANTED = Path(__file__).parents[1] / "data" / "planted_faults"
EXPRESSIONS, SOLVING, BENCH = "planted_expressions", "planted_solving", "planted_bench"

SOUND = [
    ("model", EXPRESSIONS, "Arm"),
    ("effect", EXPRESSIONS, "Springy"),
    ("measurement", EXPRESSIONS, "Gauge"),
    ("measurement", EXPRESSIONS, "SumAndDifference"),
    ("measurement", EXPRESSIONS, "Ledge"),
    ("reader", SOLVING, "Table"),
    ("estimator", SOLVING, "Newton"),
    ("online", SOLVING, "Filter"),
    ("exporter", SOLVING, "Printer"),
    ("exporter", SOLVING, "RefusesAnArm"),
    ("device", BENCH, "Board"),
    ("tracker", BENCH, "Udp"),
    ("joints", BENCH, "Lines"),
]

FAULTS = [
    ("model", EXPRESSIONS, "BlockInDegrees", "expected rad"),
    ("model", EXPRESSIONS, "MillimetresCalledMetres", "plausible in their units"),
    ("model", EXPRESSIONS, "MillimetresInExpression", "changes by 0.00"),
    ("model", EXPRESSIONS, "DegreesCalledRadians", "for each rad of zero"),
    ("model", EXPRESSIONS, "DottedName", "the name 'tip.x'"),
    ("model", EXPRESSIONS, "TwinName", "two parameters called 'link'"),
    ("model", EXPRESSIONS, "OutsideItsDomain", "nominal values"),
    ("model", EXPRESSIONS, "IdleParameter", "an influence"),
    ("model", EXPRESSIONS, "Floored", "which branches on it"),
    ("model", EXPRESSIONS, "NumericBranch", "one joint for each name"),
    ("model", EXPRESSIONS, "OutsideNumpy", "an influence"),
    ("model", EXPRESSIONS, "CallbackWithoutDerivative", "derivatives are finite and agree"),
    ("model", EXPRESSIONS, "RemembersSymbols", "the same each time"),
    ("model", EXPRESSIONS, "DriftsEachCall", "the same each time"),
    ("model", EXPRESSIONS, "LongAxis", "one joint for each name"),
    ("model", EXPRESSIONS, "Stretching", "rigid motions"),
    ("model", EXPRESSIONS, "OneJointShort", "one joint for each name"),
    ("model", EXPRESSIONS, "Talkative", "prints nothing"),
    ("model", EXPRESSIONS, "Reseeding", "leaves the process alone"),
    ("model", EXPRESSIONS, "Silencing", "leaves the process alone"),
    ("model", EXPRESSIONS, "BareLength", "a number without a unit"),
    ("model", EXPRESSIONS, "UnitInItsName", "a number without a unit"),
    ("model", EXPRESSIONS, "AcceptsAnyKey", "unknown key"),
    ("effect", EXPRESSIONS, "LagInDegrees", "changes by 57.3 rad for each rad of lag"),
    ("effect", EXPRESSIONS, "DeflectionInDegrees", "a deflection changes by 57.3 rad"),
    ("effect", EXPRESSIONS, "LongDirection", "expected a unit vector"),
    ("effect", EXPRESSIONS, "BranchingLaw", "which branches on it"),
    ("effect", EXPRESSIONS, "TwoNumbersAJoint", "returned 2 x 1 numbers"),
    ("effect", EXPRESSIONS, "LearnsFromCommands", "the same each time"),
    ("measurement", EXPRESSIONS, "ResidualInMillimetres", "the residual changes by 1000 m"),
    ("measurement", EXPRESSIONS, "ReadsMillimetres", "the residual changes by 1000 m"),
    ("measurement", EXPRESSIONS, "NoiseInMillimetres", "found a noise of 0.5 m"),
    ("measurement", EXPRESSIONS, "OneNoiseTooFew", "makes a residual"),
    ("measurement", EXPRESSIONS, "NegativeNoise", "it makes a residual"),
    ("measurement", EXPRESSIONS, "FlatResidual", "makes a residual"),
    ("measurement", EXPRESSIONS, "MissesAnOutput", "it makes a residual"),
    ("measurement", EXPRESSIONS, "AddsInsteadOfSubtracting", "residual is zero"),
    ("measurement", EXPRESSIONS, "SteppedResidual", "agree with differences"),
    ("measurement", EXPRESSIONS, "ShiftsEachCall", "the same each time"),
    ("measurement", EXPRESSIONS, "IdleReading", "noise of every reading"),
    ("measurement", EXPRESSIONS, "OneReadingTwice", "noise of every reading"),
    ("measurement", EXPRESSIONS, "NoiseOfAnotherDimension", "makes a residual"),
    ("measurement", EXPRESSIONS, "PositionInAnotherOrder", "a position's residual"),
    ("measurement", EXPRESSIONS, "PositionHalved", "a position's residual"),
    ("measurement", EXPRESSIONS, "LedgeInMillimetres", "the residual changes by 1000 m"),
    ("measurement", EXPRESSIONS, "TellsTheOppositeHeight", "what the record itself says"),
    ("reader", SOLVING, "TableInDegrees", "expected [ 0.17"),
    ("reader", SOLVING, "TableThatDropsRows", "wrong or empty is reported"),
    ("reader", SOLVING, "TableThatLosesTheLastRow", "found 3 records and 0 set aside"),
    ("reader", SOLVING, "TableThatFillsIn", "wrong or empty is reported"),
    ("reader", SOLVING, "TableThatRemembers", "wrong or empty is reported"),
    ("estimator", SOLVING, "IgnoresBounds", "keeps to the bounds"),
    ("estimator", SOLVING, "AlwaysConverged", "cut short"),
    ("estimator", SOLVING, "RaisesWhenStopped", "cut short"),
    ("estimator", SOLVING, "IgnoresWeights", "weighs records"),
    ("estimator", SOLVING, "IgnoresPriors", "weighs records and priors"),
    ("estimator", SOLVING, "StartsFromTheLastAnswer", "the same each time"),
    ("estimator", SOLVING, "MovesItsStart", "changed the start"),
    ("online", SOLVING, "ForgetsTheGainTwice", "prior and record say together"),
    ("online", SOLVING, "MakesVariancesPositive", "variance below zero"),
    ("online", SOLVING, "RemembersTheLastBelief", "the same each time"),
    ("exporter", SOLVING, "StampsItsContent", "the same each time"),
    ("exporter", SOLVING, "RaisesAtAnArm", "RuntimeError: this arm is no good (planted_solving.py:"),
    ("exporter", SOLVING, "ChangesWhatItWrites", "changes the values that it is given"),
    ("exporter", SOLVING, "GivesText", "found content of type str"),
    ("device", BENCH, "SetsTheMirroredAngle", "sets the angles that it says"),
    ("device", BENCH, "SetsDegrees", "found 11.4592 rad of q1 in standing()"),
    ("device", BENCH, "RemembersItsAngles", "read from the board"),
    ("device", BENCH, "SwallowsALostLink", "passes on that the link was lost"),
    ("device", BENCH, "SaysItLivesAlone", "passes on that the link was lost"),
    ("device", BENCH, "TakesAnyAngle", "is refused"),
    ("device", BENCH, "KeepsPulsesOnRelease", "let go has no angle"),
    ("tracker", BENCH, "RaisesOnDamage", "damaged bytes"),
    ("tracker", BENCH, "RaisesOnDeepNesting", "damaged bytes"),
    ("tracker", BENCH, "CountsNothing", "damaged bytes"),
    ("tracker", BENCH, "Blocks", "still waiting after"),
    ("tracker", BENCH, "SleepsInFrames", "still waiting after"),
    ("joints", BENCH, "RaisesOnDamagedLine", "damaged bytes"),
    ("joints", BENCH, "RaisesWhereNoFileIs", "opens or refuses"),
]


@pytest.fixture(autouse=True)
def planted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(PLANTED))
    monkeypatch.setattr("armcal.testing.bench_checks._PATIENCE_S", 0.3)


def checked(kind: str, module: str, name: str) -> list[CheckResult]:
    return check_component(Component(kind, name, f"{module}:{name}", "", "planted"))


@pytest.mark.parametrize(("kind", "module", "name"), SOUND, ids=[name for _, _, name in SOUND])
def test_the_sound_twin_passes_all_that_is_known_of_its_kind(kind: str, module: str, name: str) -> None:
    results = checked(kind, module, name)
    assert [result for result in results if result.fault] == []
    ran = sum(not result.not_run for result in results)
    # What reads nothing cannot be asked whether its residual is zero where its outputs are measured.
    assert ran == len(checks_of(kind)), [result for result in results if result.not_run]


@pytest.mark.quick(
    "AddsInsteadOfSubtracting", "BlockInDegrees", "IdleParameter", "ReadsMillimetres", "ResidualInMillimetres"
)
@pytest.mark.parametrize(("kind", "module", "name", "check"), FAULTS, ids=[name for _, _, name, _ in FAULTS])
def test_a_planted_fault_is_found(kind: str, module: str, name: str, check: str) -> None:
    failed = [result for result in checked(kind, module, name) if result.fault]
    assert any(check in f"{result.check}: {result.fault}" for result in failed), failed
    assert all(result.fault and "\n" not in result.fault for result in failed)


def test_every_planted_component_is_asked_after() -> None:
    asked = {(module, name) for _, module, name, *_ in (*SOUND, *FAULTS)}
    for name in (EXPRESSIONS, SOLVING, BENCH):
        module: ModuleType = __import__(name)
        own = {n for n, v in vars(module).items() if isinstance(v, type) and v.__module__ == name}
        left = {n for n in own if (name, n) not in asked and not n.startswith("_") and not n.endswith("Settings")}
        assert left - {"WithBlock", "ReadsItsOwnFormat"} == set()


# Faults of whole plugins

PLUGIN = """
from armcal.hooks import hookimpl
{more}

@hookimpl
def armcal_register_models(register):
    register("arm", "planted_expressions:Arm")
"""


def registry_of(monkeypatch: pytest.MonkeyPatch, site: Path, **texts: str) -> PluginRegistry:
    monkeypatch.syspath_prepend(str(site))
    for name, text in texts.items():
        (site / f"planted_{name}.py").write_text(text, encoding="utf-8")
        monkeypatch.delitem(sys.modules, f"planted_{name}", raising=False)
    return discover([EntryPoint(name, f"planted_{name}", "armcal") for name in texts])


def failed_checks(registry: PluginRegistry) -> list[CheckResult]:
    return [result for plugin in registry.plugins for result in check_plugin(plugin, registry) if result.fault]


def test_the_sound_plugin_passes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert failed_checks(registry_of(monkeypatch, tmp_path, sound=PLUGIN.format(more=""))) == []


PLUGIN_FAULTS = {
    "missing": ("import no_such_module_of_anybody", "it loads", "ModuleNotFoundError"),
    "misspelt": ("@hookimpl\ndef armcal_register_modells(register): pass", "it loads", "unknown hook"),
    "unmarked": ("def armcal_register_effects(register): pass", "it loads", "is not marked"),
}


@pytest.mark.quick("missing", "misspelt", "unmarked")
@pytest.mark.parametrize("name", PLUGIN_FAULTS)
def test_a_fault_of_a_registration_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    more, check, said = PLUGIN_FAULTS[name]
    failed = failed_checks(registry_of(monkeypatch, tmp_path, **{name: PLUGIN.format(more=more)}))
    assert [result for result in failed if check in result.check and said in result.fault], failed


@pytest.mark.slow
def test_two_plugins_of_one_component_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    text = PLUGIN.format(more="")
    failed = failed_checks(registry_of(monkeypatch, tmp_path, one=text, two=text))
    assert len(failed) == 2
    assert all(
        "is offered once" in each.check and "by one" in each.fault and "and two" in each.fault for each in failed
    )


# The one call for a plugin's own tests


def test_one_call_checks_a_class_or_its_name() -> None:
    by_name = assert_contract(f"{EXPRESSIONS}:Arm", "model")
    by_class = assert_contract(__import__(EXPRESSIONS).Arm, "model", at_least=10)
    assert [r.check for r in by_name] == [r.check for r in by_class]


def test_one_call_lists_every_fault() -> None:
    with pytest.raises(AssertionError, match="breaks the plugin contract") as fault:
        assert_contract(f"{EXPRESSIONS}:MillimetresCalledMetres", "model")
    assert "plausible in their units" in str(fault.value)
    assert "is it in mm?" in str(fault.value)


def test_one_call_wants_enough_checks_to_have_run() -> None:
    count = len(assert_contract(f"{SOLVING}:Printer", "exporter"))
    with pytest.raises(AssertionError, match=f"{count} checks ran, expected at least {count + 1}"):
        assert_contract(f"{SOLVING}:Printer", "exporter", at_least=count + 1)


def test_a_component_of_which_too_little_can_be_checked_is_no_pass() -> None:
    """A reader whose format is no table and that shows no example passes every check that runs, and is refused."""
    results = assert_contract(f"{BENCH}:ReadsItsOwnFormat", "reader", at_least=1)
    assert sum(bool(result.not_run) for result in results) == 1
    with pytest.raises(AssertionError, match="has no EXAMPLE_SOURCE"):
        assert_contract(f"{BENCH}:ReadsItsOwnFormat", "reader")


def test_what_does_not_import_is_a_fault_of_the_component() -> None:
    with pytest.raises(AssertionError, match="it imports: ModuleNotFoundError"):
        assert_contract("no_such_module_of_anybody:Model", "model")
    with pytest.raises(AssertionError, match="expected module:attribute"):
        assert_contract("no_such_module_of_anybody", "model")


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="'motor', expected one of model, effect"):
        assert_contract(f"{EXPRESSIONS}:Arm", "motor")


@pytest.mark.slow
def test_our_own_components_pass_and_every_kind_has_checks() -> None:
    for component in discover().components:
        if component.module.startswith("armcal_"):
            assert [result for result in check_component(component) if result.fault] == [], component
    assert set(CHECKS) == {"", *KINDS} - {"command", "report_section"}
