"""Springs without loads, masses that no arm has and centres of mass that no link has are seen before the fit."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from armcal.arm.statics import MassSpec
from armcal.diagnose.data import masses as checked_masses
from armcal.errors import ConfigError, NotConvergedError
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble

DEMO = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "demo.yaml"
LINKS = ("link1", "link2", "link3", "link4", "link5", "link6", "target", "holder")
WEIGHTLESS = [f"arms.arm.links.{link}.mass_g=0" for link in LINKS]


def test_free_springs_that_nothing_loads_are_refused_with_what_to_state() -> None:
    with pytest.raises(ConfigError) as refused:
        assemble(Experiment.load(DEMO, [*WEIGHTLESS, "evaluator=interpreted"]), Stopwatch())
    text = refused.value.message
    assert "the springs of arm are free (arm.spring.k" in text and "no link has a mass" in text
    assert "arms.arm.links" in refused.value.hint and "take the springs out" in refused.value.hint
    assert refused.value.where is not None and refused.value.where.line is not None


@pytest.mark.parametrize("loaded", ["statics.payload_g=200", "statics.force_N=[0, 0, -3]"])
def test_what_hangs_or_pulls_loads_them(loaded: str) -> None:
    assemble(Experiment.load(DEMO, [*WEIGHTLESS, loaded, "evaluator=interpreted"]), Stopwatch())


@pytest.mark.slow
def test_grams_read_as_kilograms_are_said_before_the_fit_and_in_the_verdict() -> None:
    experiment = Experiment.load(DEMO, ["arms.arm.links.link2.mass_g=177000", "evaluator=interpreted"])
    (finding,) = checked_masses(experiment)
    assert finding.grade == "warning" and "link2: 177 kg" in finding.text and "Are these grams?" in finding.text
    try:
        ready = assemble(experiment, Stopwatch(), accept=True)
        assert finding in ready.findings and any(finding.text in text for text in ready.notices)
    except NotConvergedError as fault:  # such an arm may hang down from its springs
        assert any(finding.text in note for note in fault.__notes__)


def test_a_centre_of_mass_beyond_the_arm_is_refused_where_it_is_written() -> None:
    with pytest.raises(
        ConfigError, match="the centre of mass of link2 is 12 m from the origin of upper_arm"
    ) as refused:
        Experiment.load(DEMO, ["arms.arm.links.link2.com_mm=[12000, 0, 0]"])
    assert "expected at most 1.1" in refused.value.message and "Are these millimetres?" in refused.value.hint


@pytest.mark.parametrize(
    ("name", "length", "masses"),
    [
        ("SO-101", 0.42, (0.52,)),
        ("Meca500", 0.5, (4.5,)),
        ("IRB 120", 1.0, (25.0,)),
        ("TX2-40", 0.87, (29.0,)),
        ("UR10", 1.68, (7.8, 12.9, 3.9, 2.0, 2.0, 0.4)),
        ("M-10iA", 2.0, (130.0,)),
        ("KR 16", 2.4, (235.0,)),
        ("M-410iC palletiser", 3.9, (2410.0,)),
        ("M-2000iA", 5.0, (11000.0,)),
        ("a pan and tilt", 0.05, (0.3,)),
    ],
)
def test_arms_as_they_are_sold_are_not_warned_of(name: str, length: float, masses: tuple[float, ...]) -> None:
    """Whole masses, bases counted, and lengths from joint to joint, about as data sheets have them; grams are seen."""
    for factor, warned in ((1.0, False), (1000.0, True)):
        own = tuple(MassSpec(f"link{i}", factor * mass, (0.0, 0.0, 0.0), "tool") for i, mass in enumerate(masses))
        system = SimpleNamespace(arms={"arm": SimpleNamespace(masses=own, length=length)})
        assert bool(checked_masses(SimpleNamespace(system=system))) is warned, name
