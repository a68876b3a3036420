"""What a study compares: variants of one configuration, and how they are judged."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from armcal.base.settings import Mass, Settings
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError

PREVIOUS = "previous"
"""As a reference: each variant is compared with the one before it."""


class ModelStudySettings(Settings):
    """Variants compared by cross-validation, all on the same folds of the same records.

    ``reference`` is what each is compared with: a variant, or ``previous`` for a ladder. ``repeats`` draws the folds
    anew. ``nested`` chooses a variant inside each fold's training records and judges the choice on the fold.
    ``blocks`` is the number of neighbouring records that are resampled together for standard errors.
    """

    kind: Literal["models"] = "models"
    variants: Annotated[dict[str, Any], Field(min_length=1)]
    reference: str = PREVIOUS
    folds: Annotated[int, Field(ge=2)] = 5
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    seed: Annotated[int, Field(ge=0)] = 0
    nested: bool = False
    blocks: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"


class LoadTransferSettings(Settings):
    """Variants trained at some payloads and judged at others.

    ``payloads`` are simulated, or looked for in the records' payload column, to the nearest tenth of a gram (by
    default all that are in it). Where a fit is judged at a payload it trained on, ``folds`` keep the two apart.
    """

    kind: Literal["load_transfer"]
    variants: Annotated[dict[str, Any], Field(min_length=1)]
    payloads: tuple[Mass, ...] = ()
    folds: Annotated[int, Field(ge=2)] = 5
    seed: Annotated[int, Field(ge=0)] = 0


_KINDS: dict[str, type[ModelStudySettings] | type[LoadTransferSettings]] = {
    "models": ModelStudySettings,
    "load_transfer": LoadTransferSettings,
}


class _ModelStudyFile(Settings):
    study: ModelStudySettings


class _LoadTransferFile(Settings):
    study: LoadTransferSettings


def study_settings(source: ConfigSource) -> ModelStudySettings | LoadTransferSettings:
    """The checked section ``study`` of a configuration.

    Raises:
        ConfigError: there is none, or it is refused.
    """
    section = source.data.get("study")
    if not isinstance(section, dict):
        raise ConfigError(
            "found no study.",
            where=source.where(("study",)),
            hint="Give study: {variants: {NAME: {extends: FILE}, ...}}; see docs/study.md.",
        )
    kind = section.get("kind", "models")
    if kind not in _KINDS:
        raise ConfigError(
            f"found kind {kind!r}, expected {' or '.join(_KINDS)}.", where=source.where(("study", "kind"))
        )
    part = ConfigSource({"study": section}, source.marks, source.path, source.root, source.files)
    if kind == "load_transfer":
        return _load_transfer(part)
    settings = validate(_ModelStudyFile, part).study
    if settings.reference not in (PREVIOUS, *settings.variants):
        names = ", ".join(settings.variants)
        raise ConfigError(
            f"found the reference {settings.reference!r}, expected {PREVIOUS} or one of {names}.",
            where=source.where(("study", "reference")),
        )
    return settings


def _load_transfer(source: ConfigSource) -> LoadTransferSettings:
    settings = validate(_LoadTransferFile, source).study
    grams = [round(payload * 1e4) for payload in settings.payloads]
    if len(set(grams)) < len(grams) or len(grams) == 1 or min(grams, default=0) < 0:
        raise ConfigError(
            "expected at least two different payloads, none below zero.",
            where=source.where(("study", "payloads")),
            hint="Write for example payloads_g: [0, 66.3].",
        )
    return settings
