"""What a study knows when it ends, and the files that it leaves: numbers, a row a record, the configuration."""

from dataclasses import asdict, dataclass
from typing import Any

from armcal.base.arrays import Array
from armcal.base.config_text import as_json
from armcal.base.dataset import Dataset
from armcal.calibration.calibration_file import dump
from armcal.config.variants import SECTION
from armcal.estimate.validation import ErrorSummary, in_unit
from armcal.io.cells import csv_text
from armcal.run.study import Study

FILES = ("experiment.yaml", "study.csv", "study.json", "study.html")


@dataclass(frozen=True)
class Change:
    """One model against another, record by record; negative is better.

    Attributes:
        against: the other model.
        mean: of the differences of each record's error.
        standard_error: of that mean, from blocks of neighbouring records; the fitted models are taken as given.
        block: how many neighbours a block has.
        helped: the share of records whose error is smaller.
        most_helped: ids and differences of the records that gain most.
        most_hurt: of those that lose most.
    """

    against: str
    mean: float
    standard_error: float
    block: int
    helped: float
    most_helped: tuple[tuple[str, float], ...]
    most_hurt: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class VariantTurns:
    """Errors of orientations (deg) of one variant, as its errors of lengths."""

    nominal: ErrorSummary
    train: ErrorSummary
    crossed: ErrorSummary


@dataclass(frozen=True)
class VariantResult:
    """One variant, judged.

    Attributes:
        name: of the variant.
        free: how many numbers the fit may change.
        nominal: errors without calibration (mm).
        train: errors of a fit on all records, on the same records (mm).
        crossed: errors of each record by a fit that did not see it (mm), the mean of each figure over the repeats.
        at_rest: the same if nothing is known of a drift; equal where nothing drifts.
        errors_mm: ``crossed`` record by record, mean over the repeats (N; nan where a fold did not converge).
        change: against the variant it is compared with (mm); None for the reference itself.
        converged: whether the fit on all records did.
        failed_folds: how many fits of the cross-validation did not converge.
        fit_seconds: of the fit on all records.
        seconds: of all fits of this variant.
        turns: errors of orientations, where they are measured beside lengths.
    """

    name: str
    free: int
    nominal: ErrorSummary
    train: ErrorSummary
    crossed: ErrorSummary
    at_rest: ErrorSummary
    errors_mm: Array
    change: Change | None
    converged: bool
    failed_folds: int
    fit_seconds: float
    seconds: float
    turns: VariantTurns | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        turns = self.turns
        turned = turns and {
            "nominal": turns.nominal.as_dict(),
            "train": turns.train.as_dict(),
            "cross_validated": turns.crossed.as_dict(),
        }
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


@dataclass(frozen=True, kw_only=True)
class _Judged:
    """What every finished study has.

    Attributes:
        name: of the study.
        command: how to repeat it.
        dataset: the records.
        warnings: of configs, data and problems.
        seconds: of each stage.
        provenance: hashes and versions.
        unit: of all errors; ``mrad`` where nothing measured is a length.
    """

    name: str
    command: str
    dataset: Dataset
    warnings: tuple[str, ...]
    seconds: dict[str, float]
    provenance: dict[str, Any]
    unit: str = "mm"

    def content(self, kind: str, **own: Any) -> dict[str, Any]:
        ends = {"warnings": list(self.warnings), "seconds": dict(self.seconds), "provenance": self.provenance}
        return dict(in_unit({"study": self.name, "kind": kind, **own, **ends}, self.unit))


@dataclass(frozen=True, kw_only=True)
class StudyResult(_Judged):
    """A finished comparison.

    Attributes:
        folds: how many.
        repeats: how often they were drawn.
        variants: in the order written.
        best: the variant with the lowest cross-validated mean error, of those whose fits all converged.
        simplest: the one with the fewest parameters within one standard error of it.
        nested: if it was asked for.
    """

    folds: int
    repeats: int
    variants: tuple[VariantResult, ...]
    best: str
    simplest: str
    nested: NestedResult | None

    def variant(self, name: str) -> VariantResult:
        return next(v for v in self.variants if v.name == name)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        nested = self.nested
        return self.content(
            "models",
            records=len(self.dataset),
            folds=self.folds,
            repeats=self.repeats,
            variants=[variant.as_dict() for variant in self.variants],
            lowest=self.best,
            simplest_within_one_standard_error=self.simplest,
            nested=nested and {"error_mm": nested.crossed.as_dict(), "chosen": list(nested.chosen)},
        )


@dataclass(frozen=True)
class TransferCell:
    """One variant trained at some payloads and judged at one (mm).

    ``trained_g`` is empty for the nominal model; with ``seen`` the records that judge were at a payload that also
    trained, and were kept out of the training by folds. ``turns`` are errors of orientations (deg), where measured.
    """

    variant: str
    trained_g: tuple[float, ...]
    judged_g: float
    errors: ErrorSummary
    seen: bool
    failed_fits: int
    turns: ErrorSummary | None = None

    def as_dict(self) -> dict[str, Any]:
        return {
            "variant": self.variant,
            "trained_at_g": list(self.trained_g),
            "judged_at_g": self.judged_g,
            "error_mm": self.errors.as_dict(),
            **({"orientation_error_deg": self.turns.as_dict()} if self.turns else {}),
            "cross_validated": self.seen,
            "failed_fits": self.failed_fits,
        }


@dataclass(frozen=True, kw_only=True)
class TransferResult(_Judged):
    """A finished load transfer study; ``errors_mm`` by variant and payloads trained at, record by record."""

    simulated: bool
    payloads_g: tuple[float, ...]
    counts: tuple[int, ...]
    cells: tuple[TransferCell, ...]
    errors_mm: dict[tuple[str, tuple[float, ...]], Array]

    def as_dict(self) -> dict[str, Any]:
        return self.content(
            "load_transfer",
            simulated=self.simulated,
            payloads_g=list(self.payloads_g),
            records=list(self.counts),
            cells=[cell.as_dict() for cell in self.cells],
        )


def files(result: StudyResult | TransferResult, study: Study, page: str) -> dict[str, str]:
    return {
        "experiment.yaml": dump(self_contained(study)),
        "study.csv": _csv_text(result),
        "study.json": as_json(result.as_dict()) + "\n",
        "study.html": page,
    }


def self_contained(study: Study) -> dict[str, Any]:
    """The configuration with each variant as the sections in which it differs: no other file is needed."""
    read = next((e.source.data["data"] for e in study.experiments.values() if "data" in e.source.data), None)
    data = study.source.data if read is None else {**study.source.data, "data": read}
    base = {key: section for key, section in data.items() if key != SECTION}
    variants = {}
    for name, experiment in study.experiments.items():
        own = experiment.source.data
        differing = {key: section for key, section in own.items() if base.get(key) != section}
        variants[name] = {"set": differing | {key: None for key in base if key not in own}}
    return {**data, SECTION: {**data[SECTION], "variants": variants}}


def _csv_text(result: StudyResult | TransferResult) -> str:
    """A row a record, an error a variant, by a fit that did not see the record."""
    if isinstance(result, StudyResult):
        columns = {f"{v.name}_{result.unit}": v.errors_mm for v in result.variants}
        if result.nested:
            columns[f"chosen_inside_{result.unit}"] = result.nested.errors_mm
    else:
        columns = {
            f"{name}_trained_at_{'_and_'.join(f'{g:g}' for g in trained)}_g_{result.unit}": errors
            for (name, trained), errors in result.errors_mm.items()
        }
    dataset = result.dataset
    if isinstance(result, TransferResult):
        columns = {"payload_g": dataset.column("payload") * 1000, **columns}
    rows = dataset.rows or ("",) * len(dataset)
    body = zip(dataset.ids, rows, *columns.values(), strict=True)
    return csv_text([["pose_id", "source_row", *columns], *body])
