"""The report: one HTML file that a person decides from, readable offline and without scripts."""

from armcal.report.page import render
from armcal.report.sections import plugin_sections

__all__ = ["plugin_sections", "render"]
