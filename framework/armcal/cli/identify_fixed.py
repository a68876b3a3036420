"""What ``armcal identify --fixed`` shows: fixed parameters, and what each would gain."""

import math
from typing import Any

from armcal.base.units import display_unit, to_unit
from armcal.cli.common import Console
from armcal.estimate.validation import error_unit
from armcal.run.experiment import Experiment
from armcal.run.fixed_parameters import FixedParameters, FreedStep, fixed_parameters
from armcal.run.pipeline import Prepared

_DIMENSIONS = {"m": "length", "rad": "angle"}


def fixed_content(console: Console, experiment: Experiment, ready: Prepared) -> dict[str, Any]:
    """Fixed parameters judged, for JSON."""
    with console.progress() as progress:
        judged = fixed_parameters(experiment, ready, progress)
    return {
        "unit": error_unit(ready.problem),
        "error": _thousandths(judged.error),
        "gaining": [_step(judged, step) for step in judged.steps],
        "recommended": list(judged.recommended),
        "determined_and_nothing_gained": list(judged.others),
    }


def _step(judged: FixedParameters, step: FreedStep) -> dict[str, Any]:
    one = step.candidate
    return {
        "name": one.name,
        "unit": step.unit,
        "change": one.change.tolist(),
        "sd": one.sd.tolist(),
        "p_value": one.p_value,
        "error": _thousandths(step.error),
        "recommended": one.name in judged.recommended,
    }


def _thousandths(error: float) -> float | None:
    return 1000 * error if math.isfinite(error) else None


def show_fixed(console: Console, content: dict[str, Any]) -> None:
    """The table, and what to write."""
    unit = content["unit"]
    if content["gaining"]:
        first = f"held out: {content['error']:.3g} {unit} as configured; with each freed beside those above it"
        console.line(f"Fixed parameters that would explain residuals (mean error of records {first}):", "bold")
    width = max((len(step["name"]) for step in content["gaining"]), default=0)
    for step in content["gaining"]:
        sizes = f"{_shown(step['change'], step['unit'])} (sd {_shown(step['sd'], step['unit'])})"
        error = "" if step["error"] is None else f"{step['error']:.3g} {unit}"
        console.line(f"  {step['name']:{width}}  {sizes:34}  {error:10} {'free it' if step['recommended'] else ''}")
    others = content["determined_and_nothing_gained"]
    if others:
        console.line(f"Determined too, and nothing is gained ({len(others)}): {', '.join(others)}.")
    if content["recommended"]:
        console.line("Add to parameters.free:", "bold")
        console.line(f"  [{', '.join(content['recommended'])}]")
    else:
        console.line("Free no more: records held out would not be predicted better than by chance.", "green")


def _shown(numbers: list[float], unit: str) -> str:
    dimension = _DIMENSIONS.get(unit)
    name = display_unit(dimension).name if dimension else unit
    factors = [to_unit(number, name) if dimension else number for number in numbers]
    return f"{', '.join(f'{number:.2g}' for number in factors)} {'' if name == '1' else name}".strip()
