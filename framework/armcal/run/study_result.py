"""What a study knows when it ends, and the files that it leaves: numbers, a row a record, the configuration."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from armcal.base.arrays import Array
from armcal.base.config_text import as_json
from armcal.base.dataset import Dataset
from armcal.calibration.calibration_file import dump
from armcal.config.yaml_source import VARIANTS, ConfigSource
from armcal.estimate.validation import ErrorSummary, in_unit
from armcal.io.cells import csv_text

FILES = ("experiment.yaml", "study.csv", "study.json", "study.html")


@dataclass(frozen=True)
class Change:
    """One model against another, record by record; negative is better."""

    against: str  # the other model
    mean: float  # of the differences of each record's error
    standard_error: float  # of that mean, from blocks of neighbouring records; the fitted models are taken as given
    block: int  # how many neighbours a block has
    helped: float  # the share of records whose error is smaller
    most_helped: tuple[tuple[str, float], ...]  # ids and differences of the records that gain most
    most_hurt: tuple[tuple[str, float], ...]  # of those that lose most


@dataclass(frozen=True)
class VariantResult:
    """One variant, judged.

    Attributes:
        crossed: errors of each record by a fit that did not see it (mm), the mean of each figure over the repeats.
        turns: errors of orientations (deg), where they are measured beside lengths: ``nominal``, ``train``,
            ``cross_validated``.
    """

    name: str  # of the variant
    free: int  # how many numbers the fit may change
    nominal: ErrorSummary  # errors without calibration (mm)
    train: ErrorSummary  # errors of a fit on all records, on the same records (mm)
    crossed: ErrorSummary
    at_rest: ErrorSummary  # the same if nothing is known of a drift; equal where nothing drifts
    errors_mm: Array  # ``crossed`` record by record, mean over the repeats (N; nan where a fold did not converge)
    change: Change | None  # against the variant it is compared with (mm); None for the reference itself
    converged: bool  # whether the fit on all records did
    failed_folds: int  # how many fits of the cross-validation did not converge
    fit_seconds: float  # of the fit on all records
    seconds: float  # of all fits of this variant
    turns: Mapping[str, ErrorSummary] | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        turned = {name: turns.as_dict() for name, turns in (self.turns or {}).items()}
        return {
            "name": self.name,
            "free": self.free,
            "error_mm": {
                "nominal": self.nominal.as_dict(),
                "train": self.train.as_dict(),
                "cross_validated": self.crossed.as_dict(),
                "cross_validated_at_rest": self.at_rest.as_dict(),
            },
            **({"orientation_error_deg": turned} if turned else {}),
            "change_mm": self.change and asdict(self.change),
            "converged": self.converged,
            "failed_folds": self.failed_folds,
            "seconds": {"fit": self.fit_seconds, "all_fits": self.seconds},
        }


@dataclass(frozen=True)
class NestedResult:
    """The choice itself, judged: made inside of each fold's training records, its errors on the fold (mm).

    ``chosen`` is the variant that each fold chose; ``errors_mm`` (N) is nan where the chosen fit did not converge.
    """

    crossed: ErrorSummary
    chosen: tuple[str, ...]
    errors_mm: Array


@dataclass(frozen=True)
class Cell:
    """One variant trained at some groups of records and judged at one (mm).

    ``trained`` is empty for the nominal model; with ``seen`` the records that judge were of a group that also
    trained, and were kept out of the training by folds. ``turns`` are errors of orientations (deg), where measured.
    """

    variant: str
    trained: tuple[str, ...]
    judged: str
    errors: ErrorSummary
    seen: bool
    failed_fits: int
    turns: ErrorSummary | None = None

    def as_dict(self) -> dict[str, Any]:
        return {
            "variant": self.variant,
            "trained_at": list(self.trained),
            "judged_at": self.judged,
            "error_mm": self.errors.as_dict(),
            **({"orientation_error_deg": self.turns.as_dict()} if self.turns else {}),
            "cross_validated": self.seen,
            "failed_fits": self.failed_fits,
        }


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """A finished study."""

    name: str
    command: str  # that repeats it
    dataset: Dataset
    simulated: bool
    folds: int
    repeats: int
    variants: tuple[VariantResult, ...]  # in the order written
    best: str  # the lowest cross-validated mean error, of those whose fits all converged
    simplest: str  # the fewest parameters within one standard error of it
    nested: NestedResult | None
    group_by: str | None
    labels: tuple[str, ...]  # the group of each record
    groups: Mapping[str, int]  # records of each; empty where nothing groups them
    cells: tuple[Cell, ...]
    trained_mm: Mapping[tuple[str, tuple[str, ...]], Array]  # by variant and groups trained at, record by record
    warnings: tuple[str, ...]
    seconds: dict[str, float]
    provenance: dict[str, Any]
    unit: str = "mm"  # of all errors; ``mrad`` where nothing measured is a length

    def variant(self, name: str) -> VariantResult:
        return next(v for v in self.variants if v.name == name)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        nested, grouped = self.nested, {}
        if self.group_by is not None:
            cells = [cell.as_dict() for cell in self.cells]
            grouped = {"group_by": self.group_by, "simulated": self.simulated, "groups": dict(self.groups)}
            grouped["cells"] = cells
        content = {
            "study": self.name,
            "records": len(self.dataset),
            "folds": self.folds,
            "repeats": self.repeats,
            "variants": [variant.as_dict() for variant in self.variants],
            "lowest": self.best,
            "simplest_within_one_standard_error": self.simplest,
            "nested": nested and {"error_mm": nested.crossed.as_dict(), "chosen": list(nested.chosen)},
            **grouped,
            "warnings": list(self.warnings),
            "seconds": dict(self.seconds),
            "provenance": self.provenance,
        }
        return dict(in_unit(content, self.unit))


def files(result: StudyResult, study: ConfigSource, variants: Mapping[str, ConfigSource], page: str) -> dict[str, str]:
    return {
        "experiment.yaml": dump(_self_contained(study, variants)),
        "study.csv": _csv_text(result),
        "study.json": as_json(result.as_dict()) + "\n",
        "study.html": page,
    }


def _self_contained(study: ConfigSource, variants: Mapping[str, ConfigSource]) -> dict[str, Any]:
    """The configuration with each variant as the sections in which it differs: no other file is needed."""
    read = next((own.data["data"] for own in variants.values() if "data" in own.data), None)
    data = study.data if read is None else {**study.data, "data": read}
    base = {key: section for key, section in data.items() if key != VARIANTS[0]}
    listed = {}
    for name, own in variants.items():
        differing = {key: section for key, section in own.data.items() if base.get(key) != section}
        listed[name] = {"set": differing | {key: None for key in base if key not in own.data}}
    return {**data, VARIANTS[0]: {**data[VARIANTS[0]], "variants": listed}}


def _csv_text(result: StudyResult) -> str:
    """A row a record, an error a variant, by a fit that did not see the record."""
    columns: dict[str, Any] = {} if result.group_by is None else {result.group_by: result.labels}
    columns |= {f"{v.name}_{result.unit}": v.errors_mm for v in result.variants}
    if result.nested:
        columns[f"chosen_inside_{result.unit}"] = result.nested.errors_mm
    for (name, trained), errors in result.trained_mm.items():
        if len(trained) < len(result.groups):
            columns[f"{name}_trained_at_{'_and_'.join(trained).replace(' ', '_')}_{result.unit}"] = errors
    dataset = result.dataset
    rows = dataset.rows or ("",) * len(dataset)
    body = zip(dataset.ids, rows, *columns.values(), strict=True)
    return csv_text([["pose_id", "source_row", *columns], *body])
