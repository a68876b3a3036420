"""Make the figures of the pages anew, each from a real run: ``python docs/tools/figures.py``.

Pictures of a report need chromium; where there is none, the pictures in docs/figures stay as they are.
"""

from __future__ import annotations

import base64
import io
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FIGURES = ROOT / "docs" / "figures"
SECTIONS = {
    "verdict": "header",
    "accuracy": "#accuracy",
    "corrections": "#corrections",
    "joints": "#joints",
    "records": "#records",
}
"""Each picture of the report page, and the part of report.html that it shows."""
WIDTH = 1000
MOST_HEIGHT = 1400
_COLOURS = 96
_PLACE = """(() => {
  const box = document.querySelector(%r).getBoundingClientRect();
  return {x: 0, y: box.top + scrollY - 8, width: %d, height: Math.min(box.height + 16, %d), scale: 1};
})()"""


def main() -> int:
    """All of them; 0, or 2 where a run fails."""
    FIGURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="armcal-figures-") as place:
        config = ROOT / "configs" / "lrm_arm" / "demo.yaml"
        command = ["armcal", "run", str(config), "--out", f"{place}/run", "--quiet"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.stderr.write(f"docs/tools/figures.py: {' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
            return 2
        return pictures(Path(place) / "run" / "report.html", Path(place))


def pictures(report: Path, place: Path) -> int:
    """Each section of a report as a small picture."""
    sys.path.insert(0, str(ROOT / "tests"))
    from browser import CHROMIUM, Browser

    if CHROMIUM is None:
        sys.stderr.write("docs/tools/figures.py: no chromium is installed; the pictures stay as they are.\n")
        return 0
    browser = Browser(place / "profile", WIDTH, 900)
    try:
        browser.resize(WIDTH, 900)
        browser.open(report.as_uri())
        browser.wait_for("document.querySelector('footer')")
        for name, part in SECTIONS.items():
            clip = browser.value(_PLACE % (part, WIDTH, MOST_HEIGHT))
            taken = browser.ask("Page.captureScreenshot", format="png", clip=clip, captureBeyondViewport=True)
            (FIGURES / f"report_{name}.png").write_bytes(smaller(base64.b64decode(taken["data"])))
    finally:
        browser.close()
    return 0


def smaller(png: bytes) -> bytes:
    """The picture in few colours: a third of the bytes, and it looks the same."""
    from PIL import Image

    kept = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(_COLOURS).save(kept, "PNG", optimize=True)
    return kept.getvalue()


if __name__ == "__main__":
    sys.exit(main())
