"""Sound readers, estimators, online estimators, simulators and exporters, and twins of each with one fault planted."""

from __future__ import annotations

import csv
import itertools
import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings
from armcal.base.units import from_unit, split_suffix
from armcal.calibration.exporter import Exported
from armcal.errors import ConfigError, DataError, Location
from armcal.estimate.estimator import Solution, SolverVerdict, no_progress
from armcal.estimate.online import Gaussian, Update, checked
from armcal.problem.problem import PosedProblem

from tests.joseph import kalman_update

COUNTER = itertools.count()


class TableSettings(Settings):
    path: InputPath


class Table:
    """Sound: a table with a unit in each column's name."""

    Settings: ClassVar[Any] = TableSettings

    def __init__(self, settings: Any) -> None:
        self.path = Path(settings.path)

    def read(self, request: Any) -> Any:
        header, *rows = self.rows()
        places = self.places(header, request)
        ids, numbers = [], []
        for line, cells in enumerate(rows, start=2):
            found = self.numbers(cells, places, header, line)
            if found is not None:
                ids.append(f"{line}")
                numbers.append(found)
        values = np.array(numbers).T
        return Dataset(tuple(ids), dict(zip(places, values, strict=True)), source=str(self.path))

    def rows(self) -> Any:
        try:
            text = self.path.read_bytes().decode("utf-8")
            found = [row for row in csv.reader(text.splitlines(), strict=True) if row]
        except (OSError, UnicodeDecodeError, csv.Error) as fault:
            raise DataError(f"it cannot be read ({fault}).", where=Location(str(self.path))) from fault
        if len(found) < 2:
            raise DataError("it has no rows.", where=Location(str(self.path)))
        return found

    def places(self, header: Any, request: Any) -> Any:
        names = {(split[0] if (split := split_suffix(name)) else name): i for i, name in enumerate(header)}
        lacking = [w.columns[0] for w in request.channels if w.required and not set(w.columns) & set(names)]
        if lacking:
            raise DataError(f"no column {', '.join(lacking)}.", where=Location(str(self.path)))
        wanted = {w.channel: next((names[c] for c in w.columns if c in names), None) for w in request.channels}
        return {channel: place for channel, place in wanted.items() if place is not None}

    def numbers(self, cells: Any, places: Any, header: Any, line: int) -> Any:
        try:
            return [self.number(float(cells[place]), header[place]) for place in places.values()]
        except (ValueError, IndexError) as fault:
            raise DataError(f"no number ({fault}).", where=Location(str(self.path), line=line)) from fault

    def number(self, value: float, name: str) -> float:
        if not math.isfinite(value):
            raise ValueError(f"found {value}")
        split = split_suffix(name)
        return from_unit(value, split[1].name) if split else value


class TableInDegrees(Table):
    def number(self, value: float, name: str) -> float:
        return value if name.endswith("_deg") else super().number(value, name)


class TableThatDropsRows(Table):
    def numbers(self, cells: Any, places: Any, header: Any, line: int) -> Any:
        try:
            return super().numbers(cells, places, header, line)
        except DataError:
            return None


class TableThatLosesTheLastRow(Table):
    def rows(self) -> Any:
        return super().rows()[:-1]


class TableThatFillsIn(Table):
    def numbers(self, cells: Any, places: Any, header: Any, line: int) -> Any:
        padded = [cell if cell.replace(".", "").strip("-").isdigit() else "0" for cell in cells]
        return super().numbers(padded, places, header, line)


class TableThatRemembers(Table):
    """What was read once is given again from its class."""

    kept: ClassVar[dict[str, Any]] = {}

    def rows(self) -> Any:
        rows = super().rows()
        return self.kept.setdefault(self.path.name, rows)


class NewtonSettings(Settings):
    max_iterations: int = 30


class Newton:
    """Sound: Gauss-Newton steps, clipped to the bounds."""

    Settings: ClassVar[Any] = NewtonSettings

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    def solve(self, problem: Any, start: Any, progress: Any = no_progress) -> Any:
        posed = PosedProblem(self.taken(problem))
        low, high = posed.bounds()
        x, count, moved = np.clip(self.start(posed, start), low, high), 0, math.inf
        while count < self.settings.max_iterations and moved > 1e-12:
            model = self.model(posed, x)
            there = self.kept(x - np.linalg.solve(model[1], model[0]), low, high)
            moved, x, count = float(np.abs(there - x).max()), there, count + 1
        return Solution(posed.values(x), SolverVerdict("newton", "done", self.verdict(moved), count, 0.0))

    def taken(self, problem: Any) -> Any:
        return problem

    def start(self, posed: Any, start: Any) -> Any:
        return posed.x(start)

    def model(self, posed: Any, x: Any) -> Any:
        found = posed.model(x)
        return found.gradient, found.hessian

    def kept(self, x: Any, low: Any, high: Any) -> Any:
        return np.clip(x, low, high)

    def verdict(self, moved: float) -> bool:
        return moved <= 1e-12


class IgnoresBounds(Newton):
    def kept(self, x: Any, low: Any, high: Any) -> Any:
        return x


class AlwaysConverged(Newton):
    def verdict(self, moved: float) -> bool:
        return True


class IgnoresWeights(Newton):
    def taken(self, problem: Any) -> Any:
        return problem.weighted([1 / each.weight[: each.count] for each in problem.records])


class IgnoresPriors(Newton):
    def model(self, posed: Any, x: Any) -> Any:
        found = posed.problem.normal_equations(posed.values(x))
        scales = posed.coordinate_scales
        return scales * found.gradient, found.hessian * np.outer(scales, scales)


class StartsFromTheLastAnswer(Newton):
    """The second answer is not the first one, by a rounding error or more."""

    last: Any = None

    def solve(self, problem: Any, start: Any, progress: Any = no_progress) -> Any:
        found = super().solve(problem, start, progress)
        nudged = found.values if self.last is None else found.values + 1e-9
        self.last = found.values
        return Solution(np.minimum(nudged, found.values + 1e-9), found.verdict)


class MovesItsStart(Newton):
    def start(self, posed: Any, start: Any) -> Any:
        x = posed.x(start)
        start += 1e-3
        return x


class RaisesWhenStopped(Newton):
    def verdict(self, moved: float) -> bool:
        if moved > 1e-12:
            raise RuntimeError("not converged")
        return True


class PlainSettings(Settings):
    pass


class Filter:
    """Sound: a Kalman filter."""

    Settings: ClassVar[Any] = PlainSettings

    def __init__(self, settings: Any) -> None:
        pass

    def update(self, prior: Any, observation: Any) -> Any:
        seen = self.seen(observation.at(prior.mean))
        posterior = self.posterior(prior, seen)
        expected = seen.slope @ prior.covariance @ seen.slope.T + seen.noise
        return Update(posterior, seen.innovation, expected)

    def seen(self, seen: Any) -> Any:
        return seen

    def posterior(self, prior: Any, seen: Any) -> Any:
        return kalman_update(prior, seen, prior.mean)


class ForgetsTheGainTwice(Filter):
    """The short form of the covariance with a gain that is too small."""

    def posterior(self, prior: Any, seen: Any) -> Any:
        sound = super().posterior(prior, seen)
        return Gaussian(sound.mean, 0.5 * (sound.covariance + prior.covariance))


class MakesVariancesPositive(Filter):
    def posterior(self, prior: Any, seen: Any) -> Any:
        repaired = Gaussian(prior.mean, prior.covariance + np.diag(np.where(np.diag(prior.covariance) < 0, 1.0, 0.0)))
        return checked(kalman_update(repaired, seen, prior.mean))


class RemembersTheLastBelief(Filter):
    bias = 0.0

    def posterior(self, prior: Any, seen: Any) -> Any:
        sound = super().posterior(prior, seen)
        self.bias += 1e-12
        return Gaussian(sound.mean + self.bias, sound.covariance)


class Printer:
    """Sound: an arm's parameters as text."""

    Settings: ClassVar[Any] = PlainSettings

    def __init__(self, settings: Any) -> None:
        pass

    def export(self, request: Any) -> Any:
        lines = [f"{name} {value.tolist()}" for name, value in sorted(request.values.items())]
        return Exported("\n".join(lines).encode(), len(lines))


class StampsItsContent(Printer):
    def export(self, request: Any) -> Any:
        found = super().export(request)
        return Exported(found.content + f" {next(COUNTER)}".encode(), found.changed)


class RaisesAtAnArm(Printer):
    def export(self, request: Any) -> Any:
        raise RuntimeError("this arm is no good")


class RefusesAnArm(Printer):
    """Sound: what cannot be written is refused."""

    def export(self, request: Any) -> Any:
        raise ConfigError("it writes other arms.")


class ChangesWhatItWrites(Printer):
    def export(self, request: Any) -> Any:
        for value in request.values.values():
            value *= 1000
        return super().export(request)


class GivesText(Printer):
    def export(self, request: Any) -> Any:
        return Exported(super().export(request).content.decode(), 1)
