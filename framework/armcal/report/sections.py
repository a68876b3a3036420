"""Sections that plugins add to the report of a run."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from armcal.plugins import PluginRegistry, said
from armcal.run.result import RunResult


@dataclass(frozen=True)
class ReportSection:
    """A section of the report, after armcal's own.

    Attributes:
        title: its heading, plain text.
        html: what stands below it: HTML that needs no other file and no script, since the page must open offline.
    """

    title: str
    html: str


class SectionMaker(Protocol):
    """A function of a run's ``armcal.RunResult`` (SI and radians) that gives an ``armcal.ReportSection(title, html)``.

    It gives None where it has nothing to say of the run. What it raises costs nobody the report: a warning stands in
    the section's place. ``html`` needs no other file and no script, since the page must open offline.
    """

    def __call__(self, result: RunResult) -> ReportSection | None:
        """The section of this run, if there is one."""


@dataclass(frozen=True)
class PluginSection:
    """A registered section as the page shows it."""

    name: str  # as registered
    content: ReportSection | None  # None where ``fault`` says why there is none
    fault: str = ""


def plugin_sections(result: RunResult, registry: PluginRegistry) -> Sequence[PluginSection]:
    """The sections that plugins have for this run, by name."""
    sections = []
    for name in sorted({c.name for c in registry.components if c.kind == "report_section"}):
        try:
            component = registry.find("report_section", name)
            content = component.load()(result)
            if content is not None and not isinstance(content, ReportSection):
                raise TypeError(f"found {type(content).__name__}, expected an armcal.ReportSection or None")
        except Exception as fault:  # a plugin may fail in any way, and must not cost anybody a calibration
            sections.append(PluginSection(name, None, f"the report section {name!r} failed: {said(fault)}"))
        else:
            if content is not None:
                sections.append(PluginSection(name, content))
    return sections
