"""Make the page of checks from their list: ``python docs/tools/checks_page.py``; a test compares the two."""

import json
from pathlib import Path

from armcal.diagnose.checks import DATA_CHECKS, EXACT, FIT_CHECKS, NO_RATE, NOTES

PAGE = Path(__file__).resolve().parents[1] / "checks.md"
RUNS = Path(__file__).resolve().parents[2] / "tests" / "data" / "clean_runs.json"
HEAD = f"""# Checks

Each run asks these questions of its data and of its fit. What they find stands in the verdict, with how it was tested
and what to do; `armcal checks` lists them, those of your plugins too. This page is made of that list by
`docs/tools/checks_page.py`. Do not edit it.

The last but one column says how often a check warns of sound data of the very model. `0.5 %` is the level of its test:
all levels add up to 5 %, but that of a held scale, on which every length rests. `0 of 1,200` was counted. A check that
is `{EXACT}` states a fact, one with `{NOTES}` never warns; `{NO_RATE}` stands where nothing was counted. A check of
your own is [one function](write_a_plugin.md#a-check).
"""


def of_sound_runs() -> list[str]:
    kinds = json.loads(RUNS.read_text(encoding="utf-8"))
    rows = [
        f"| {kind} | {own['runs']} | {own['grades'].get('warning', 0)} | "
        f"{', '.join(f'{name} {count}' for name, count in own['checks'].items()) or '-'} |"
        for kind, own in kinds.items()
    ]
    text = (
        "Sound recordings of 20 to 300 records, simulated with the stated noise and calibrated as a user would "
        "(`python -m tests.clean_runs`). None was graded bad, none refused."
    )
    head = ["| Instrument | Runs | With a warning | Of which check |", "| --- | --- | --- | --- |"]
    return ["## Warnings of sound data", "", text, "", *head, *rows, ""]


def as_markdown() -> str:
    lines = [HEAD]
    for title, checks in (("Of the data, before the fit", DATA_CHECKS), ("Of the fit", FIT_CHECKS)):
        lines += [f"## {title}", "", "| Check | What it asks | False alarms | Page |", "| --- | --- | --- | --- |"]
        lines += [f"| `{c.name}` | {c.question} | {c.rate} | [{c.page[:-3]}]({c.page}) |" for c in checks]
        lines.append("")
    lines += of_sound_runs()
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(as_markdown(), encoding="utf-8")
