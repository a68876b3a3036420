"""What the site's build does to pages, so that the site stands alone and works from a disk.

- Formulas become MathML, which browsers draw by themselves: no script, no network.
- ``[Key]`` of REFERENCES.md becomes a link to that entry, and REFERENCES.md and CHANGELOG.md become pages.
- Other files of the checkout are named, not linked.
- The search's helper for pages on a disk is ours, not fetched from elsewhere.
"""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
ADDED = {"REFERENCES.md": "references.md", "CHANGELOG.md": "changelog.md"}
_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
_OUTSIDE = re.compile(r"\[([^\]]+)\]\(\.\./([^)#]+)(#[^)]*)?\)")
_ENTRY = re.compile(r"^- \*\*\[(\w+)\]\*\*", re.MULTILINE)
_CODE = re.compile(r"(^ *```.*?^ *```|`[^`\n]+`)", re.DOTALL | re.MULTILINE)
_KEY = re.compile(r"\[([A-Z][A-Za-z]*\d{2,4}|URDF|DTrack2|PCA9685)\](?![(\[])")
_FETCHED = re.compile(r'<script src="https://[^"]*iframe-worker[^"]*"></script>')


def on_files(files: Any, config: Any) -> Any:
    """Pages that stand at the top of the checkout."""
    from mkdocs.structure.files import File

    for name, page in ADDED.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        if name == "REFERENCES.md":
            text = _ENTRY.sub(r'- <a id="\1"></a>**[\1]**', text)
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links out of docs/, and keys of references."""
    source = page.file.src_uri
    if source == ADDED["REFERENCES.md"]:
        return markdown
    known = set(_ENTRY.findall((ROOT / "REFERENCES.md").read_text(encoding="utf-8")))

    def linked(match: re.Match[str]) -> str:
        target = ADDED.get(match[2])
        return f"[{match[1]}]({target}{match[3] or ''})" if target else f"{match[1]} (`{match[2]}` in the checkout)"

    def referred(match: re.Match[str]) -> str:
        key = match[1]
        return f"[\\[{key}\\]](references.md#{key})" if key in known else match[0]

    parts = _CODE.split(markdown)
    parts[::2] = [_KEY.sub(referred, _OUTSIDE.sub(linked, part)) for part in parts[::2]]
    return "".join(parts)


def on_page_content(content: str, **_: Any) -> str:
    """Formulas as MathML."""
    content = _BLOCK.sub(lambda match: _mathml(match[1], "block"), content)
    return _INLINE.sub(lambda match: _mathml(match[1], "inline"), content)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """The helper for searching on a disk, from this site."""
    up = "../" * page.url.count("/")
    return _FETCHED.sub(f'<script src="{up}javascripts/local_search.js"></script>', output)


def on_post_template(output_content: str, template_name: str, **_: Any) -> str:
    """The same for the page that is shown where there is none, which a server needs and a disk does not."""
    return _FETCHED.sub("", output_content) if template_name.endswith(".html") else output_content


def _mathml(formula: str, display: str) -> str:
    from latex2mathml.converter import convert

    return str(convert(html.unescape(formula).strip(), display=display))
