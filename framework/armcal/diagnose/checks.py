"""The list of checks: what each asks of the data or of a fit, and how often it warns of sound ones.

A check is a function of a fit (``armcal.diagnose.fit.Fit``), or of the data before a fit (``Prepared`` there), that
gives findings. It stands here by its module and name, which are imported when it runs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any, Literal, Protocol

from armcal.plugins import PluginRegistry, said

Grade = Literal["good", "note", "warning", "bad"]
EXACT, NOTES, NO_RATE = "exact", "notes only", "no rate yet"
"""Of a check that states a fact and tests nothing, that never warns, or whose false alarms were not counted.

A level, ``0.5 %``, is what a test allows: all levels add up to 5 %, but that of a held scale, on which every length
rests. A count, ``0 of 1,200``, is of how many sound recordings, of six kinds of instrument, the check warned."""


@dataclass(frozen=True)
class Finding:
    """One row of the verdict: how much it matters, what it is, how it was tested at which level, what to do."""

    grade: Grade
    text: str
    test: str = ""
    action: str = ""


class CheckFunction(Protocol):
    """A function of a fit (``armcal.diagnose.fit.Fit``) that gives findings: none where it has nothing to say.

    ``rate`` says how often it warns of sound data, ``"exact"`` where it states a fact, and ``page`` where it is
    explained; ``before_fit = True`` hands it the data before the fit (``armcal.diagnose.fit.Prepared``). All three are
    attributes of the function and may be left out. What it raises costs nobody a calibration: a warning stands in place
    of its findings.
    """

    def __call__(self, fit: Any) -> Sequence[Finding]:
        """What there is to say of this fit."""


@dataclass(frozen=True)
class Check:
    name: str
    question: str  # that it answers
    rate: str  # of false alarms: the level stated for sound data, ``EXACT`` or ``NO_RATE``
    target: str  # module:function; of armcal's own below ``armcal.diagnose``
    page: str = "numbers.md"  # of the documentation
    plugin: str = ""  # that registered it; empty for armcal's own

    def findings(self, subject: Any) -> list[Finding]:
        """Of a fit, or of data before it; what a plugin's check raises is a warning in their place."""
        if not self.plugin:
            return list(resolve_name(f"armcal.diagnose.{self.target}")(subject))
        try:
            findings = list(resolve_name(self.target)(subject))
            if not all(isinstance(one, Finding) for one in findings):
                raise TypeError(f"found {findings!r}, expected a list of armcal.Finding")
        except Exception as fault:  # a plugin may fail in any way, and must not cost anybody a calibration
            return [Finding("warning", f"The check {self.name!r} of the plugin {self.plugin} failed: {said(fault)}.")]
        return findings


DATA_CHECKS = (
    Check("axes", "Would the data fit far better with axes or joints exchanged, reversed or coupled?", "0 of 1,200",
          "data:mixed_up", "troubleshooting.md"),
    Check("reach", "Are all positions in one unit, and as far out as the arm reaches?", "0 of 1,200", "data:reach",
          "data.md"),
    Check("masses", "Does the arm weigh what an arm of its length may weigh?", "0 of 1,200", "data:masses",
          "models.md"),
    Check("gravity", "Where springs bend: is gravity stated, in the frame of the measurements?", "0 of 1,200",
          "data:gravity", "calibrate.md"),
)  # fmt: skip
"""Of data before a fit."""

FIT_CHECKS = (
    Check("converged", "Did the solver converge?", EXACT, "verdict:converged"),
    Check("before", "What did the checks of the data find, and what became of a pose residual?", EXACT,
          "verdict:found_before", "pose_residual.md"),
    Check("determined", "Do the data determine all free parameters, and does the tip depend on the others?", EXACT,
          "verdict:determined", "identifiability.md"),
    Check("condition", "Is a combination of parameters hardly determined?", EXACT, "verdict:conditioned",
          "identifiability.md"),
    Check("bounds", "Do the data push against a bound?", "0.5 %", "verdict:bounds"),
    Check("shifts", "Do bounds that hold shift other estimates?", EXACT, "verdict:shifts"),
    Check("noise", "Are residuals as large as the declared noise, and whose are they?", "0.5 %", "verdict:noise",
          "noise.md"),
    Check("freedom", "Are equations left beside the free parameters?", EXACT, "verdict:freedom"),
    Check("instruments", "Do records contradict what an instrument holds: a board's size, a lens?", "0.1 %",
          "causes:instruments", "board.md"),
    Check("rounding", "Were recorded joint angles rounded?", "0 of 1,200", "gross:rounded", "data.md"),
    Check("structure", "What do residuals still depend on, and what does their scatter?", "1 %",
          "residual_structure:depends", "mathematics.md"),
    Check("repeats", "Do repeats of a pose scatter as much as residuals?", "0.5 %", "residual_structure:repeated"),
    Check("neighbours", "Do records that follow one another miss alike, and how much wider are intervals?", EXACT,
          "residual_structure:neighbours", "mathematics.md"),
    Check("correlated", "Which estimates correlate strongly?", EXACT, "verdict:correlated", "identifiability.md"),
    Check("computed", "Do the tips come from the joints, not from an instrument?", "0 of 1,200", "gross:computed",
          "data.md"),
    Check("gross", "Is the error gross beside the arm's reach?", "0 of 1,200", "gross:gross"),
    Check("jump", "Do the records contradict one another from one place on?", "0 of 1,200", "gross:jumped"),
    Check("minority", "Do many records contradict the others?", "0 of 1,200", "record_checks:contradicting"),
    Check("size", "Is the calibrated arm as large as the nominal one?", "0.4 %", "gross:size"),
    Check("displaced", "Is a parameter far from its prior or its nominal value?", "0 of 1,200", "gross:displaced"),
    Check("scale", "Which error of an instrument's scale would not show?", "5 %", "gross:scale", "trackers.md"),
    Check("payload", "Which payload would not show?", EXACT, "gross:payload", "effects.md"),
    Check("elsewhere", "How well is the tool known away from the contacts?", EXACT, "verdict:away",
          "ball_and_sockets.md"),
    Check("worse", "Are unseen records missed by more than by the nominal arm?", "0.5 %", "gross:worse"),
    Check("turns", "Are orientations grossly off, or worse than the nominal arm's?", "0 of 1,200", "gross:turns"),
    Check("aligned", "Are positions far worse than those aligned before the fit?", "0 of 1,200", "gross:aligned"),
    Check("overfitted", "Are unseen records missed by far more than those that trained?", "2 of 1,200",
          "gross:overfit"),
    Check("weights", "Does the declared noise predict better than estimated variances?", NOTES, "gross:weights",
          "noise.md"),
    Check("intervals", "Do prediction intervals cover their share?", "0.5 %", "record_checks:covered"),
    Check("places", "How well are base and target known?", EXACT, "verdict:places"),
    Check("moved", "Did what the arm touches move?", "0 of 1,200", "record_checks:moved", "ball_and_sockets.md"),
    Check("still", "Did a joint stand still?", EXACT, "data:still", "data.md"),
    Check("same_poses", "Are held-out records at poses that trained?", EXACT, "data:same_poses"),
    Check("outliers", "Are records missed by more than noise explains?", "1 %", "record_checks:outlying", "noise.md"),
    Check("next", "What is least certain, and which poses would add most?", EXACT, "verdict:next_poses", "plan.md"),
)  # fmt: skip
"""Of a fit, in the order of the verdict within one grade."""


def plugin_checks(registry: PluginRegistry, before_fit: bool) -> Iterator[Check]:
    for component in sorted((c for c in registry.components if c.kind == "check"), key=lambda one: one.name):
        own = component.load()
        if bool(getattr(own, "before_fit", False)) == before_fit:
            rate, page = getattr(own, "rate", NO_RATE), getattr(own, "page", "")
            yield Check(component.name, component.summary, rate, component.target, page, component.plugin)


def first_few(texts: Sequence[str], most: int = 5) -> str:
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "")
