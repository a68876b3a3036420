"""The report: complete, safe, offline, and quick, whatever a run left behind."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from armcal.base.dataset import Dataset, SetAside
from armcal.base.domains import Interval, Pose, Semidefinite
from armcal.base.parameters import ParameterBlock, Parameters, scalar
from armcal.config.system import StaticsSettings, System
from armcal.diagnose.causes import contradictions
from armcal.diagnose.fit import Fit, Prepared, RecordErrors
from armcal.diagnose.gross import hidden_payload, rounding
from armcal.diagnose.record_checks import intervals, large_errors, noise_of, outlying
from armcal.diagnose.residual_structure import depends, structure
from armcal.diagnose.verdict import (
    Verdict,
    bounds,
    conditioned,
    converged,
    correlated,
    determined,
    elsewhere,
    freedom,
    in_all,
    new_recording,
    next_poses,
    noise,
    priors_alone,
    shifts,
    suggestions,
)
from armcal.estimate.estimator import Estimate, SolverVerdict
from armcal.estimate.identifiability import analyse
from armcal.estimate.start import Start
from armcal.estimate.validation import Split, hold_out
from armcal.problem.problem import Problem
from armcal.report.page import page as page_of
from armcal.report.run_document import run_document
from armcal.run.result import RunResult
from fits import fit_that_found

SECTIONS = ("verdict", "accuracy", "parameters", "reproduce")


def render(result: RunResult) -> str:
    return page_of(run_document(result))


CHROMIUM = shutil.which("chromium")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
)
VOID = {"meta", "link", "br", "hr", "img", "input"}


def blocks(count: int = 28, springs: int = 7) -> Parameters:
    """``count`` free scalars, the last ``springs`` of them compliances, and three fixed ones."""
    made = []
    for i in range(count - springs):
        joint, kind = i // 4 + 1, ("alpha", "a", "theta", "d")[i % 4]
        angular = kind in ("alpha", "theta")
        nominal = (np.pi / 2, 0.0963, 0.0, 0.1035)[i % 4]
        unit, scale = ("rad", 0.05) if angular else ("m", 0.01)
        made.append(replace(scalar(f"arm.mdh.{kind}{joint}", unit, nominal, scale), free=True))
    for i in range(springs):
        block = scalar(f"arm.spring.k{i}", "rad_per_Nm", 0.0, 0.05, Interval(lower=0.0))
        made.append(replace(block, free=True))
    made += [scalar(f"arm.mdh.base_{a}", "m", 0.01 * i, 0.01) for i, a in enumerate("xyz")]
    return Parameters(tuple(made))


def estimate_of(parameters: Parameters, freedom: int = 700, undetermined: int = 0, seed: int = 1) -> Estimate:
    """Synthetic values and a covariance with one strongly correlated pair; the last compliance at its bound."""
    rng = np.random.default_rng(seed)
    free, scales = parameters.free_entries, parameters.scales()
    count = len(scales)
    design = rng.normal(size=(4 * count + 4, count)) * np.geomspace(1, 3, count) if count else np.zeros((1, 0))
    if count > 3:
        design[:, 2] = design[:, 1] + 0.2 * design[:, 2]
    design[:, count - undetermined : count] = 0.0
    triangle = np.linalg.qr(design / scales)[1] if count else np.zeros((0, 0))
    known = analyse(triangle, scales, parameters.coordinate_names)
    chain = parameters.retract_jacobian(np.zeros(count))
    inverse = np.linalg.pinv((triangle * scales).T @ (triangle * scales), rcond=1e-16, hermitian=True)
    covariance = 0.05 * chain @ (scales[:, None] * inverse * scales) @ chain.T
    values = parameters.retract(rng.normal(size=count) * scales / 2)
    unconstrained = values[list(free)].copy()
    for i, name in enumerate(parameters.entry_names[j] for j in free):
        if ".k" in name:
            values[free[i]] = unconstrained[i] = abs(values[free[i]]) + 0.004
    if count and parameters.free[-1].domain == Interval(lower=0.0):
        values[free[-1]], unconstrained[-1] = 0.0, -0.0004
    told = SolverVerdict("ipopt", "Solve_Succeeded", True, 23, 0.412, 8, 8)
    return Estimate(
        parameters=parameters,
        values=values,
        free_entries=free,
        covariance=covariance,
        unconstrained=unconstrained,
        square_root_information=triangle,
        noise_scale=1.4,
        degrees_of_freedom=freedom,
        identifiability=known,
        verdict=told,
    )


def result_of(
    count: int = 313,
    parameters: Parameters | None = None,
    holdout: float = 0.2,
    crossed: bool = False,
    undetermined: int = 0,
    name: str = "picobot laser tracker",
    ids: tuple[str, ...] | None = None,
) -> RunResult:
    rng = np.random.default_rng(7)
    azimuth, reach = rng.uniform(-2.2, 2.2, count), rng.uniform(0.15, 0.42, count)
    position = 1000 * np.vstack([reach * np.cos(azimuth), reach * np.sin(azimuth), 0.05 + rng.uniform(0, 0.35, count)])
    after = rng.normal(size=(3, count)) * (0.25 + reach) * 0.9
    before = after + np.vstack([6 * np.cos(azimuth), 5 * np.sin(azimuth), -4 - 12 * reach])
    if count > 100:
        after[:, 41] *= 4
    split = hold_out(count, holdout, 3)
    errors = RecordErrors(
        np.linalg.norm(before, axis=0),
        np.linalg.norm(after, axis=0),
        np.linalg.norm(after, axis=0) * 1.06 if crossed else np.full(count, np.nan),
        before,
        after,
        position,
        np.linalg.norm(before, axis=0),
        np.linalg.norm(before, axis=0),
    )
    found = estimate_of(parameters or blocks(), freedom=max(3 * count - 28, 1), undetermined=undetermined)
    fit = fit_known(found, errors, split, _dataset(count, position, ids))
    checks = (converged, determined, conditioned, bounds, shifts, noise, freedom, depends, correlated, outlying)
    return RunResult(
        name=name,
        command="armcal calibrate configs/picobot.yaml --out runs/picobot",
        fit=fit,
        verdict=in_all(fit, [finding for check in (*checks, next_poses) for finding in check(fit)]),
        warnings=("arm.mdh.d2 and arm.mdh.d3 are nearly parallel: a prior holds their difference.",),
        seconds={"read": 0.021, "compile": 1.312, "solve": 0.412, "report": 0.2, "total": 1.945},
        provenance={
            "config": "configs/picobot.yaml",
            "config_sha256": "5c1f" * 16,
            "versions": {"armcal": "0.1.0", "python": "3.11.2", "casadi": "3.6.5", "numpy": "1.26.4"},
        },
    )


def fit_known(
    found: Estimate,
    errors: RecordErrors,
    split: Split,
    dataset: Dataset,
    backend: str = "casadi, generated C (gcc -O2)",
) -> Fit:
    system, problem = System({}, {}, StaticsSettings(), {}), SimpleNamespace(backend=backend)
    ready = Prepared(system, dataset, cast(Problem, problem), split, cast(Start, None))
    nothing = (structure, priors_alone, rounding, large_errors, elsewhere, new_recording, hidden_payload)
    analyses = {**dict.fromkeys(nothing), contradictions: (), suggestions: (), intervals: {}}
    analyses[noise_of] = np.ones(len(dataset)), 3.0
    judged = np.where(np.isin(np.arange(len(dataset)), split.holdout), errors.calibrated_mm, np.nan)
    return fit_that_found(found, analyses, ready, errors=errors, judged_mm=judged, unit="mm", name="Tip", drifts=False)


def _dataset(count: int, position: np.ndarray, ids: tuple[str, ...] | None) -> Dataset:
    return Dataset(
        ids=ids or tuple(f"p{i:04d}" for i in range(count)),
        channels={f"tracker.{axis}": position[i] / 1000 for i, axis in enumerate("xyz")},
        rows=tuple(range(2, count + 2)),
        source="data/picobot_2024-03-11.csv",
        sha256="9f" * 32,
        set_aside=(SetAside(17, "p0016", "tracker lost the target"), SetAside(99, "p0098", "x_mm is empty")),
        warnings=("the column temperature has no unit and is not used",),
    )


class Page(HTMLParser):
    """Balanced tags, section ids, attributes, and the text of each element."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.ids: list[str] = []
        self.tags: set[str] = set()
        self.references: list[str] = []
        self.words: list[str] = []
        self.header_cells_without_scope = 0
        self.feed(html)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        given = dict(attrs)
        if given.get("id"):
            self.ids.append(str(given["id"]))
        self.references += [str(v) for k, v in attrs if k in ("src", "href", "xlink:href", "action", "data", "srcset")]
        assert not [k for k, _ in attrs if k.startswith("on")]
        self.header_cells_without_scope += tag == "th" and "scope" not in given
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def checked(html: str) -> Page:
    """What holds for every report."""
    page = Page(html)
    assert [i for i in page.ids if i in SECTIONS] == list(SECTIONS)
    assert len(page.ids) == len(set(page.ids))
    assert all(r.startswith("#") or r == "data:," for r in page.references), page.references
    assert {r[1:] for r in page.references if r.startswith("#")} <= set(page.ids)
    assert not page.tags & {"script", "iframe", "object", "embed", "img", "base", "form"}
    assert "url(" not in html and "@import" not in html and "@font-face" not in html
    assert "default-src 'none'" in html
    assert page.header_cells_without_scope == 0
    drawn = re.findall(r"<(?:path|rect|text|circle) [^>]*>", html)
    assert not [mark for mark in drawn if re.search(r"\b(nan|inf)\b", mark)]
    return page


def test_a_usual_run_is_complete() -> None:
    result = result_of(crossed=True)
    page = checked(render(result))
    assert result.verdict.headline in page.text
    for finding in result.verdict.findings:
        assert " ".join(finding.text.split()) in page.text
    for words in ("arm.mdh.alpha1", "at its bound", "63 records held out", "cross-validated 313 nominal", "p0041"):
        assert words in page.text
    for words in ("tracker lost the target", "no unit and is not used", "9f" * 32, "casadi, generated C", "ipopt"):
        assert words in page.text
    assert result.command in page.text
    assert "rad/Nm" in page.text


def test_every_figure_has_words_for_those_who_hear_it() -> None:
    html = render(result_of())
    figures = re.findall(r"<svg .*?</svg>", html, re.DOTALL)
    assert len(figures) >= 9  # the keys of legends among them
    for figure in figures:
        if 'aria-hidden="true"' in figure:
            continue
        named = re.search(r'aria-labelledby="(\S+) (\S+)"', figure)
        assert named and all(f'id="{ident}"' in figure for ident in named.groups())


def test_what_users_write_is_escaped() -> None:
    bad = "<script>alert(1)</script>\"'&<b>"
    ids = (bad, *(f"p{i}" for i in range(39)))
    parameters = Parameters(tuple(replace(b, name=b.name + "<i>'\"") for b in blocks().blocks))
    result = result_of(40, parameters, ids=ids, name=bad)
    result.errors.calibrated_mm[0] = 50.0
    data = replace(result.dataset, source=bad, set_aside=(SetAside(1, bad, bad),), warnings=(bad,))
    fit = fit_known(result.estimate, result.errors, result.split, data, bad)
    hostile = replace(result, fit=fit, command=bad, warnings=(bad,), provenance={bad: {bad: bad}})
    html = render(hostile)
    checked(html)
    assert "<script" not in html and "<i>" not in html and "<b>" not in html
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in html


def test_no_holdout_and_no_cross_validation() -> None:
    page = checked(render(result_of(holdout=0.0)))
    assert "records held out" not in page.text and "cross-validated" not in page.text
    assert "flatter the model" in page.text


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_records(count: int) -> None:
    result = result_of(max(count, 1), holdout=0.0)
    if not count:
        none = np.zeros(0)
        wide = np.zeros((3, 0))
        errors = RecordErrors(none, none, none, wide, wide, wide, none, none)
        split = Split(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp))
        data = Dataset((), {})
        result = replace(result, fit=fit_known(result.estimate, errors, split, data))
    checked(render(result))


def test_no_free_parameter_and_nothing_known() -> None:
    fixed = Parameters(tuple(replace(b, free=False) for b in blocks().blocks))
    known = result_of()
    fit = fit_known(estimate_of(fixed), known.errors, known.split, known.dataset)
    result = replace(known, fit=fit, provenance={}, seconds={}, warnings=(), verdict=Verdict("Nothing was free.", ()))
    page = checked(render(result))
    assert "No parameter was free" in page.text


def test_undetermined_parameters_and_numbers_that_are_none() -> None:
    result = result_of(undetermined=2)
    result.errors.calibrated_mm[:3] = (np.nan, np.inf, 1e9)
    result.errors.nominal_mm[5] = np.inf
    page = checked(render(result))
    assert "free parameters; undetermined: arm.spring.k" in page.text
    assert "The data does not determine a combination" in page.text and "arm.spring.k6 alone" in page.text
    none = replace(result.estimate, degrees_of_freedom=0, noise_scale=float("nan"))
    checked(render(replace(result, fit=fit_known(none, result.errors, result.split, result.dataset))))


def test_blocks_of_several_entries() -> None:
    pose = ParameterBlock("tracker.frame", "m", (1, 0, 0, 0, 0.1, 0.2, 0.3), Pose(), 0.01, True)
    spring = ParameterBlock("arm.spring.c3", "rad_per_Nm", (0.1, 0, 0, 0.1, 0, 0.1), Semidefinite(), 0.05, True)
    page = checked(render(result_of(parameters=Parameters((pose, spring)))))
    assert "tracker.frame[qw]" in page.text and "arm.spring.c3[xy]" in page.text


def test_two_hundred_parameters() -> None:
    page = checked(render(result_of(parameters=blocks(200, 60))))
    assert "then the strongest others" in page.text


def test_a_hundred_thousand_records_stay_small() -> None:
    result = result_of(100_000, crossed=True)
    html = render(result)
    checked(html)
    assert len(html.encode()) < 5e6
    assert html.count("100\u202f000 drawn, evenly chosen") == 2


@pytest.mark.slow
def test_matplotlib_is_not_needed() -> None:
    code = "import sys, armcal.report.page, armcal.report.run_document\n"
    code += "assert 'matplotlib' not in sys.modules and 'jinja2' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_numbers_as_people_read_them() -> None:
    from armcal.base.units import shown_unit
    from armcal.report.numbers import fixed, significant

    assert fixed(-0.0001, 2) == "0.00" and fixed(-1.5, 1) == "\u22121.5" and fixed(None, 2) == "\u2013"
    assert fixed(float("-inf"), 2) == "\u2212∞" and fixed(3e9, 2) == "3.00e+09" and fixed(0.5, 1, signed=True) == "+0.5"
    assert (
        significant(1234.5) == "1\u202f230"
        and significant(2e-7) == "2.00e\u221207"
        and significant(0.01234) == "0.0123"
    )
    assert shown_unit("m") == (1000.0, "mm") and shown_unit("furlong") == (1.0, "furlong")


def _pixels(png: Path) -> tuple[int, int, set[bytes]]:
    """Width, height and the distinct rows of an 8-bit PNG."""
    raw, place, packed = png.read_bytes(), 8, b""
    width, height, _, colour = struct.unpack(">IIBB", raw[16:26])
    while place < len(raw):
        length, kind = struct.unpack(">I4s", raw[place : place + 8])
        packed += raw[place + 8 : place + 8 + length] if kind == b"IDAT" else b""
        place += 12 + length
    stride = 1 + width * {2: 3, 6: 4}[colour]
    data = zlib.decompress(packed)
    return width, height, {data[i : i + stride] for i in range(0, len(data), stride)}


def _browse(page: Path, home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(CHROMIUM), *FLAGS, f"--user-data-dir={home}", *arguments, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_shows_it(tmp_path: Path) -> None:
    page, shot = tmp_path / "report.html", tmp_path / "report.png"
    page.write_text(render(result_of(crossed=True)), encoding="utf-8")
    seen = _browse(
        page,
        tmp_path / "home",
        "--enable-logging=stderr",
        "--dump-dom",
        f"--screenshot={shot}",
        "--window-size=1200,5200",
    )
    assert "CONSOLE" not in seen.stderr, [x for x in seen.stderr.splitlines() if "CONSOLE" in x]
    if not seen.stdout:
        seen = _browse(page, tmp_path / "home", "--dump-dom")
    for section in SECTIONS:
        assert f'id="{section}"' in seen.stdout
    width, height, rows = _pixels(shot)
    assert (width, height) == (1200, 5200)
    assert len(rows) > 500
