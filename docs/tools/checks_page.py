"""Make the page of checks from their list: ``python docs/tools/checks_page.py``; a test compares the two."""

from pathlib import Path

from armcal.diagnose.checks import DATA_CHECKS, EXACT, FIT_CHECKS, NO_RATE

HEAD = f"""# Checks

Each run asks these questions of its data and of its fit. What they find stands in the verdict, with how it was tested
and what to do; `armcal checks` lists them, those of your plugins too. This page is made of that list by
`docs/tools/checks_page.py`. Do not edit it.

The rate is how often a check warns of sound data of the very model, as its test states it: `{EXACT}` where it states a
fact, `{NO_RATE}` where its false alarms were not counted. A check of your own is
[one function](write_a_plugin.md#a-check).
"""


def as_markdown() -> str:
    lines = [HEAD]
    for title, checks in (("Of the data, before the fit", DATA_CHECKS), ("Of the fit", FIT_CHECKS)):
        lines += [f"## {title}", "", "| Check | What it asks | False alarms | Page |", "| --- | --- | --- | --- |"]
        lines += [f"| `{c.name}` | {c.question} | {c.rate} | [{c.page[:-3]}]({c.page}) |" for c in checks]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    Path(__file__).resolve().parents[1].joinpath("checks.md").write_text(as_markdown(), encoding="utf-8")
