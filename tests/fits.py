"""Fits as the checks see them, of problems and estimates that tests made."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from armcal.config.system import StaticsSettings, System
from armcal.diagnose.fit import Fit, Prepared
from armcal.diagnose.residual_structure import structure
from armcal.estimate.robust import WeighedFit, ones
from armcal.estimate.start import Start
from armcal.estimate.validation import Split


def fit_of(problem, estimate, dataset, fitted=None, effects=(), limit_mm=None, **known) -> Fit:
    """A fit to all records, with an estimate or as it was ``fitted``; of some properties it is ``known`` what they are.

    ``effects`` are the types of those in the model.
    """
    every = np.arange(len(dataset), dtype=np.intp)
    plan = problem.blueprint
    described = {"arms": {"arm": {"effects": {name: {"type": name} for name in effects}}}}
    system = System(plan.arms, plan.measurements, StaticsSettings(), described)
    ready = Prepared(system, dataset, problem, Split(every, every[:0]), Start(problem), limit_mm=limit_mm)
    fit = Fit(ready, fitted or WeighedFit(None, estimate, problem, ones(problem)), None)
    vars(fit).update(known)
    return fit


def fit_that_found(estimate, analyses, ready=None, **known) -> Fit:
    """A fit of which nothing but an estimate, the results of some analyses, and some properties are known."""
    nothing = np.zeros(0, dtype=np.intp)
    ready = ready or Prepared(None, None, None, Split(nothing, nothing), None)
    fit = Fit(ready, WeighedFit(None, estimate, None, ()), None)
    fit._kept.update(analyses)
    vars(fit).update(known)
    return fit


def fit_that_left(outcome, widened=()) -> Fit:
    """A converged fit of which nothing but the structure of its residuals is known, and whether intervals grew."""
    estimate = SimpleNamespace(widened=widened, verdict=SimpleNamespace(converged=True))
    return fit_that_found(estimate, {structure: outcome}, unit="mm")


def whole(finding) -> str:
    """Its text, test and action."""
    return f"{finding.text} [{finding.test}] {finding.action}"
