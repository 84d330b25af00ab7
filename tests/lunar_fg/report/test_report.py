"""The report: complete, self-contained, escaped; drawn in a real browser."""

from __future__ import annotations

import base64
import json
import re
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from finished_run import write_finished_run
from playwright.sync_api import Browser, Page
from pyproj import CRS
from rasterio.transform import from_origin
from typer.testing import CliRunner, Result

from lunar_fg.cli import app
from lunar_fg.datasets.base import MapReference
from lunar_fg.georeference import Georeference
from lunar_fg.report import write_report
from lunar_fg.report.orbital_image import thumbnail
from lunar_fg.report.words import spans
from lunar_fg.run_folder import RunFolder

EVIL = "<script>alert('name')</script>"
FIGURES = ["map", "drift", "correction", "route", "sigma", "nees", "matches", "timing"]


def lunar_fg(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def write_ortho(path: Path, crs: str = "IAU_2015:30135", height: bool = False) -> Path:
    """An orbital map about the finished run's drive, with a dark patch at the start."""
    values = np.full((200, 200), 140, np.float32 if height else np.uint8)
    values += np.random.default_rng(0).integers(0, 60, values.shape).astype(values.dtype)
    # The drive starts at (1, 2) of a map frame with its origin at (12000, -8000).
    values[148 - 10 : 148 + 10, 51 - 10 : 51 + 10] = 10
    transform = from_origin(12_000.0 - 25.0, -8_000.0 + 76.0, 0.5, 0.5)
    with rasterio.open(
        path, "w", driver="GTiff", width=200, height=200, count=1, dtype=values.dtype,
        crs=CRS.from_user_input(crs).to_wkt(), transform=transform,
    ) as raster:  # fmt: skip
        raster.write(values, 1)
    return path


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Report of a run on the Moon with everything that a run can have."""
    folder = tmp_path_factory.mktemp("report")
    run = write_finished_run(folder / "run", name=EVIL, ortho=write_ortho(folder / "ortho.tif"))
    result = lunar_fg("report", run.path)
    assert result.exit_code == 0, result.output
    return run.path / "report.html"


def figure_data(text: str, key: str) -> dict:
    found = re.search(
        rf'<script type="application/json" id="{key}-data">(.*?)</script>', text, re.S
    )
    assert found is not None, key
    return json.loads(found[1])


def test_the_page_holds_everything_and_asks_for_nothing(page_file: Path) -> None:
    text = page_file.read_text()
    for key in FIGURES:
        assert figure_data(text, f"run0-{key}")["data"]
    assert "default-src 'none'" in text
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)=\"?https?:", text)
    assert "landmarks: segments" in text, "the effective configuration"
    assert "3.2 px apart vertically" in text, "the run's warnings"
    assert "only predicted, in 1 frame: 5." in text
    assert len(text) < 6_000_000


def test_fixes_are_told_with_their_reasons_and_their_ground(page_file: Path) -> None:
    text = page_file.read_text()
    assert "1 of 2 fixes were refused" in text
    articles = re.findall(r'<article class="(\w+)">(.*?)</article>', text, re.S)
    assert [verdict for verdict, _ in articles] == ["accepted", "refused"]
    assert "Keyframe 10" in articles[0][1]
    assert "agrees &lt;b&gt;well&lt;/b&gt;" in articles[0][1]
    assert "9.1 sigma from what was expected" in articles[1][1]
    assert 'src="data:image/jpeg' in articles[0][1], "the orbital map about it"
    names = [trace.get("name") for trace in figure_data(text, "run0-map")["data"]]
    assert "fix accepted" in names
    assert "fix refused" in names


def test_a_thumbnail_at_the_maps_edge_keeps_its_scale(tmp_path: Path) -> None:
    georeference = Georeference.of(MapReference("IAU_2015:30135", (12_000.0, -8_000.0, 0.0)))
    ortho = write_ortho(tmp_path / "ortho.tif")
    # 10 m east of the map's western edge, so that of 24 m the first 2 lie beyond it.
    uri = thumbnail(ortho, georeference, np.array([-15.0, 20.0]), 24.0)
    code = base64.b64decode(uri.removeprefix("data:image/jpeg;base64,"))
    pixels = cv2.imdecode(np.frombuffer(code, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert pixels.shape[0] == pixels.shape[1]
    beyond = round(pixels.shape[1] * 2.0 / 24.0)
    assert np.abs(pixels[:, : beyond - 8].astype(float) - 200.0).max() < 12.0
    assert pixels[:, beyond + 3 :].std() > 20.0


def test_names_are_escaped(page_file: Path) -> None:
    text = page_file.read_text()
    assert EVIL not in text
    assert "&lt;script&gt;alert" in text


def test_the_orbital_map_lies_where_it_belongs(page_file: Path) -> None:
    figure = figure_data(page_file.read_text(), "run0-map")
    (image,) = figure["layout"]["images"]
    code = image["source"].removeprefix("data:image/jpeg;base64,")
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_GRAYSCALE)
    scale = image["sizex"] / pixels.shape[1]
    assert image["sizey"] / pixels.shape[0] == pytest.approx(scale, rel=0.02)
    start = round((1.0 - image["x"]) / scale), round((image["y"] - 2.0) / scale)
    assert pixels[start[1], start[0]] < 60, "the dark patch is at the start"
    assert pixels[5, 5] > 60


def test_a_map_of_another_body_is_refused_and_the_rest_is_there(tmp_path: Path) -> None:
    ortho = write_ortho(tmp_path / "mars.tif", "IAU_2015:49935")
    run = write_finished_run(tmp_path / "run", ortho=ortho)
    assert lunar_fg("report", run.path).exit_code == 0
    text = (run.path / "report.html").read_text()
    assert "another body" in text
    assert "images" not in figure_data(text, "run0-map")["layout"]


def test_a_bare_run_has_a_report_too(tmp_path: Path) -> None:
    run = write_finished_run(tmp_path / "run", frames=3, crs=None)
    for path in (run.database_path, run.frames_path, run.route_path, run.source_path,
                 run.metrics_path, run.path / "ground_truth.tum"):  # fmt: skip
        path.unlink()
    result = lunar_fg("report", run.path, "-o", tmp_path / "page.html")
    assert result.exit_code == 0, result.output
    assert "metrics.json" in (tmp_path / "page.html").read_text(), "says what is missing"


def test_a_damaged_log_is_said(tmp_path: Path) -> None:
    run = write_finished_run(tmp_path / "run")
    with sqlite3.connect(run.database_path) as database:
        database.execute("PRAGMA user_version=99")
    assert lunar_fg("report", run.path).exit_code == 0
    assert "schema version 99" in (run.path / "report.html").read_text()


def test_what_is_no_run_is_one_line(tmp_path: Path) -> None:
    result = lunar_fg("report", tmp_path)
    assert result.exit_code == 2
    assert "is not the folder of a run" in result.stderr


def test_spans() -> None:
    assert spans([3, 7, 8, 9, 12]) == "3, 7-9, 12"
    assert spans(list(range(0, 40, 2))).endswith("14, ...")


def opened(browser: Browser, path: Path, **context: object) -> tuple[Page, list[str]]:
    page = browser.new_context(**context).new_page()
    messages: list[str] = []
    page.on("console", lambda m: messages.append(m.text) if m.type != "log" else None)
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda r: None if r.url.startswith(("file:", "data:", "blob:"))
            else messages.append(r.url))  # fmt: skip
    page.goto(path.as_uri())
    page.wait_for_selector("#run0-timing .main-svg")
    return page, messages


def wait_until(page: Page, expression: str) -> None:
    """Playwright's own wait evaluates text in the page, which the page's policy forbids."""
    for _ in range(100):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never true: {expression}")


def test_a_browser_draws_it_and_a_click_hides_a_line(browser: Browser, page_file: Path) -> None:
    page, messages = opened(browser, page_file, viewport={"width": 1280, "height": 900})
    for key in FIGURES:
        assert page.locator(f"#run0-{key} .main-svg").count() >= 1, key
    assert page.locator("#run0-map .imagelayer image, #run0-map .layer-below image").count() == 1
    truth = "document.querySelector('#run0-map .js-plotly-plot').data.find(t => t.name == 'truth')"
    assert page.evaluate(f"{truth}.visible") is None
    page.locator("#run0-map .legendtoggle").nth(1).click()
    wait_until(page, f"{truth}.visible == 'legendonly'")
    page.locator("summary", has_text="Effective configuration").click()
    assert page.get_by_text("landmarks: segments").is_visible()
    assert messages == []
    page.context.close()


def test_it_fits_a_phone(browser: Browser, page_file: Path) -> None:
    page, messages = opened(
        browser, page_file, viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True
    )
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for key in FIGURES:
        box = page.locator(f"#run0-{key} .main-svg").first.bounding_box()
        assert box is not None
        assert box["x"] >= 0.0, key
        assert box["x"] + box["width"] <= 390.0, key
    assert messages == []
    page.context.close()


def test_it_prints_with_everything_open_and_within_the_paper(
    browser: Browser, page_file: Path
) -> None:
    page, messages = opened(browser, page_file, viewport={"width": 1280, "height": 900})
    page.emulate_media(media="print")
    wait_until(
        page, "document.querySelector('#run0-drift .js-plotly-plot')._fullLayout.width == 660"
    )
    assert page.locator("details:not([open])").count() == 0
    page.emulate_media(media="screen")
    wait_until(page, "document.querySelectorAll('details[open]').length == 0")
    assert messages == []
    page.context.close()


def test_several_runs_are_set_side_by_side(
    browser: Browser, tmp_path: Path, page_file: Path
) -> None:
    runs = [write_finished_run(tmp_path / f"run{i}", name=f"seed {i}", seed=i) for i in range(3)]
    path = tmp_path / "comparison.html"
    write_report([RunFolder.open(run.path) for run in runs], path)
    page, messages = opened(browser, path)
    head = page.locator("#comparison thead th").all_inner_texts()
    assert head == ["", "seed 0", "seed 1", "seed 2"]
    assert page.locator("#all-map .main-svg").count() >= 1
    assert page.locator("#all-drift .legendtoggle").count() == 3
    page.locator("nav a", has_text="seed 2").click()
    assert page.url.endswith("#run2")
    assert messages == []
    page.context.close()
