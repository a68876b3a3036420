"""The documentation: pages that belong together, a site that needs no network, blocks that run or say they do not."""

from __future__ import annotations

import fcntl
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from pkgutil import resolve_name

import pytest
import yaml
from browser import CHROMIUM, Browser

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests import docs_commands
from tests.docs_commands import (
    DONE_BY_TESTS,
    KEPT,
    Block,
    blocks,
    commands,
    faults_of,
    page_outcome,
    pages_of,
    plain_words,
    run_armcal,
    run_bash,
    run_once,
)

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.glob("*.md"))


# Blocks


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda p: p.name)
def test_every_block_is_of_a_kind_that_is_run_or_parsed_or_says_text(page: Path) -> None:
    found = [(block.line, fault) for block in blocks(page.read_text(encoding="utf-8")) if (fault := faults_of(block))]
    assert found == []


def page_of(place: Path, *parts: str) -> Path:
    """A page with these blocks."""
    place.mkdir(exist_ok=True)
    (place / "page.md").write_text("\n".join(parts), encoding="utf-8")
    return place / "page.md"


def test_blocks_are_run_in_order_in_a_folder_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    page = page_of(
        tmp_path,
        '```yaml title="a/one.yaml"\nx: 1\n```',
        "```python\nimport yaml\nx = yaml.safe_load(open('a/one.yaml'))['x']\n```",
        "```sh\ntest -d configs\necho 5 > b\n```",
        "- in a list\n\n  ```python\n  assert x + int(open('b').read()) == 6\n  ```",
        "```console\n$ test -f b\nwhat it says\n$ rm b\n```",
        "```text\nexit 1\n```",
    )
    told = page_outcome(page)
    assert told.faults == [] and told.done == 5
    assert not (ROOT / "b").exists()


@pytest.mark.parametrize(
    "text",
    [
        "```bash\ntrue\n```",
        "```\ntrue\n```",
        "```yaml\na: [\n```",
        "```json\n{]\n```",
        "```sh\nfalse\ntrue\n```",
        "```console\n$ false\n$ true\n```",
        "```python\nassert False\n```",
        "```python\nraise SystemExit(0)\n```",
        "```python run\nassert False\n```",
    ],
)
def test_what_is_wrong_with_a_block_is_told_with_its_line(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    told = page_outcome(page_of(tmp_path, "first line", text))
    assert len(told.faults) == 1 and "page.md:2" in told.faults[0]


@pytest.mark.slow
def test_what_needs_no_shell_runs_in_a_fork_and_says_the_same() -> None:
    quoted = ["armcal", "check", "a.yaml", "--set", "parameters.free=[arm.*]"]
    assert plain_words("armcal check a.yaml --set 'parameters.free=[arm.*]'") == quoted
    for text in ("armcal a | b", "armcal a > b", "armcal a; b", "armcal $A", "armcal *.yaml", "armcal a\narmcal b"):
        assert plain_words(text) == []
    for words in (["--version"], ["chek"]):
        code, out, err = run_armcal(["armcal", *words])
        done = run_bash(" ".join([sys.executable, "-m", "armcal.cli", *words]))
        assert (code, out, err) == done and out + err


def test_a_run_is_made_once_and_copied_where_nothing_but_its_folder_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def run(words: list[str]) -> tuple[int, str, str]:
        folder = Path(words[words.index("--out") + 1])
        folder.mkdir()
        (folder / "metrics.json").write_text(folder.name)
        made.append(folder.name)
        return int("bad.yaml" in words), "", "said"

    def output(folder: str, config: str = "configs/a.yaml", *more: str) -> str:
        run_once(["armcal", "run", config, "--out", folder, *more])
        return (Path(folder) / "metrics.json").read_text()

    monkeypatch.setattr(docs_commands, "run_armcal", run)
    monkeypatch.setenv(KEPT, str(tmp_path))
    (tmp_path / "page" / "configs").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "page")
    assert [output("one"), output("two"), output("three", "configs/a.yaml", "-q")] == ["one", "one", "three"]
    (tmp_path / "page" / "configs" / "a.yaml").write_text("x: 1")
    assert output("four") == "four"
    assert run_once(["armcal", "run", "bad.yaml", "--out", "five"]) == (1, "", "said")
    assert run_once(["armcal", "run", "bad.yaml", "--out", "six"]) == (1, "", "said")
    assert made == ["one", "three", "four", "five", "six"]


def test_a_fence_that_is_never_closed_is_refused() -> None:
    with pytest.raises(ValueError, match="line 2"):
        list(blocks("text\n```sh\ntrue\n"))


def test_a_block_that_is_a_file_is_not_run() -> None:
    assert commands(Block("sh", "run.sh", 1, "false\n")) == []
    assert list(blocks('```sh title="run.sh"\nfalse\n```')) == [Block("sh", "run.sh", 1, "false\n")]


def test_a_refusal_that_is_shown_is_the_one_that_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    refused = "echo 'armcal: one two   three four' >&2; exit 2"
    for shown, faults in (("armcal: one ... four", 0), ("armcal: one\n  two three four", 0), ("armcal: five", 1)):
        assert len(page_outcome(page_of(tmp_path, f"```console\n$ {refused}\n{shown}\n```")).faults) == faults, shown
    ends_well = "echo 'armcal: one' >&2"
    assert len(page_outcome(page_of(tmp_path, f"```console\n$ {ends_well}\narmcal: one\n```")).faults) == 1


def test_folders_give_their_pages() -> None:
    assert set(pages_of([str(DOCS), str(ROOT / "README.md")])) >= {*PAGES, ROOT / "README.md"}


# The site


@pytest.fixture(scope="session")
def site(of_this_run: Path) -> Path:
    """Built strictly, by the worker that is first: a link or an anchor that leads nowhere ends the build."""
    pytest.importorskip("material", reason="mkdocs-material is not installed here: pip install 'armcal[docs]'")
    place = of_this_run / "site"
    with (of_this_run / "site.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not place.exists():
            build(of_this_run / "site.new")
            (of_this_run / "site.new").rename(place)
    return place


def build(place: Path) -> None:
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(place)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


class Fetched(HTMLParser):
    """What a page makes a browser fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        wanted = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}.get(tag)
        self.addresses += [value for name, value in attrs if name == wanted and value]


@pytest.mark.slow
def test_every_page_is_in_the_site_and_in_its_contents(site: Path) -> None:
    class Loader(yaml.SafeLoader):
        """The configuration's tags for Python objects are of no interest here."""

    Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)
    nav = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)["nav"]
    named = set(re.findall(r"[\w]+\.md", json.dumps(nav)))
    assert {page.name for page in PAGES} <= named
    assert {page.stem for page in PAGES} <= {path.stem for path in site.glob("*.html")}


@pytest.mark.slow
def test_the_site_fetches_nothing_from_elsewhere(site: Path) -> None:
    for path in site.rglob("*.html"):
        page = Fetched()
        page.feed(path.read_text(encoding="utf-8"))
        assert [a for a in page.addresses if re.match(r"(https?:)?//", a)] == [], path.name
    for path in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(https?:)?//", path.read_text(encoding="utf-8")), path.name


def test_tools_of_the_build_are_not_in_the_site(site: Path) -> None:
    assert not (site / "tools").exists()


def test_formulas_are_drawn_and_keys_lead_to_references(site: Path) -> None:
    text = (site / "mathematics.html").read_text(encoding="utf-8")
    assert text.count("<math") > 20 and "arithmatex" not in text
    keys = set(re.findall(r'href="references\.html#(\w+)"', text))
    assert len(keys) > 10
    references = (site / "references.html").read_text(encoding="utf-8")
    assert all(f'id="{key}"' in references for key in keys)


def test_every_key_in_a_page_is_in_the_references() -> None:
    known = set(re.findall(r"\*\*\[(\w+)\]\*\*", (ROOT / "REFERENCES.md").read_text(encoding="utf-8")))
    for page in PAGES:
        text = re.sub(r"```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        assert set(re.findall(r"\[([A-Z][a-z]+[A-Za-z]*\d{4})\]", text)) <= known, page.name


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium is installed")
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


@pytest.mark.slow
def test_the_search_works_from_a_disk_without_a_network(site: Path, browser: Browser) -> None:
    browser.open((site / "index.html").as_uri() + "?q=backlash")
    browser.wait_for("document.querySelectorAll('.md-search-result__item').length >= 3")
    assert all(address.startswith(("file:", "data:", "blob:", "about:")) for address in browser.requested)


def test_pages_that_are_not_run_here_are_done_by_their_tests() -> None:
    for page, test in DONE_BY_TESTS.items():
        assert page in (ROOT / test).read_text(encoding="utf-8"), f"{test} no longer does docs/{page}"


def test_every_function_that_the_mathematics_name_is_there() -> None:
    table = (DOCS / "mathematics.md").read_text("utf-8").partition("## Where each formula is computed")[2]
    names = re.findall(r"`(armcal[\w.]*)`", table)
    assert len(names) > 30
    for name in names:
        assert resolve_name(name), name
