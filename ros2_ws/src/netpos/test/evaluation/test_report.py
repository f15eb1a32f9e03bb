"""The report as a reader uses it: in a headless browser, on a wide and a narrow screen, by
keyboard."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from netpos.bags import BagReader, BagWriter
from netpos.evaluation.report import write_report
from netpos.messages import topics
from netpos.scenario import load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def without_truth(source: Path, target: Path) -> Path:
    """A copy as a real network would have it, and a recorder that missed something."""
    with BagReader(source) as bag, BagWriter(target, metadata=bag.metadata) as out:
        for entry in bag.messages():
            if not topics.split(entry.topic)[1].startswith("ground_truth"):
                out.write_raw(entry.topic, entry.type_name, entry.cdr, entry.log_time_ns)
        out.note("lost", "/rsu/measurements: 7")
    return target


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two devices with ground truth, and the same run without."""
    folder = tmp_path_factory.mktemp("report")
    changes = {"devices.0.count": 2, "max_duration_s": 4.0}
    simulate_to_bag(load_scenario("fast_pass", 3, changes), folder / "simulated")
    replay_bag(folder / "simulated", folder / "a_pass")
    blind = without_truth(folder / "a_pass", folder / "blind")
    page = folder / "report.html"
    assert write_report([folder / "a_pass", blind], page, skip=5) == []
    return page


def test_losses_settings_seed_and_version_are_shown(page_file: Path) -> None:
    text = page_file.read_text(encoding="utf-8")
    assert text.index("LOST while recording: 7 of /rsu/measurements") > 0
    runs = text[text.index("<caption>Runs") :]
    row = runs[runs.index("<td") : runs.index("</tr>", runs.index("<td"))]
    for expected in ("a_pass", "fast_pass", ">3<", "0.1.0", "initial_speed_sd_mps 42.0"):
        assert expected in row
    assert text.count("measured minus true") >= 2
    assert "measured minus where the track is" in text


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    paths = [path for name in BROWSERS if (path := shutil.which(name))]
    if not paths:
        pytest.skip(f"no browser here: none of {', '.join(BROWSERS)}")
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=paths[0], args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(params=[380, 1400])
def page(browser: Any, page_file: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    page = browser.new_page(viewport={"width": request.param, "height": 800})
    complaints: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("requestfailed", lambda asked: complaints.append(asked.url))
    page.on(
        "console",
        lambda message: complaints.append(message.text) if message.type == "error" else None,
    )
    page.goto(page_file.as_uri())
    page.wait_for_selector(".map .main-svg")
    yield page
    assert complaints == []
    page.close()


def test_it_fits_its_screen(page: Any) -> None:
    """No sideways scrolling of the page; the map takes most of the width."""
    width = page.viewport_size["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for plot in page.locator(".map .plot").all():
        assert plot.bounding_box()["width"] > 0.55 * width
        assert plot.bounding_box()["height"] > 200


def test_the_slider_moves_by_keyboard(page: Any) -> None:
    section = page.locator("section").first
    shown = section.locator("output")
    before = shown.inner_text()
    section.locator("input.time").focus()
    page.keyboard.press("End")
    assert shown.inner_text() != before
    assert "vue_1 TRACKING" in shown.inner_text()
    marks = "document.querySelector('.map .js-plotly-plot').data.find(d => d.meta === 'now {}').x"
    (east, _) = page.evaluate(marks.format("estimate"))
    (true_east, _) = page.evaluate(marks.format("truth"))
    assert east == pytest.approx(true_east, abs=5.0)
    assert east > 80.0  # 42 m/s for some seconds, from -20 m on
    assert len(page.evaluate(marks.format("level"))) > 60  # two circles


def test_a_device_is_hidden_by_keyboard(page: Any) -> None:
    section = page.locator("section").first
    section.locator("input[data-device='vue_1']").focus()
    page.keyboard.press("Space")
    shown = page.evaluate(
        "[...document.querySelectorAll('section')][0].querySelectorAll('.js-plotly-plot')[1]"
        ".data.filter(d => d.visible !== false).map(d => d.meta)"
    )
    assert set(shown) == {"vue_2"}
    assert "vue_1" not in section.locator("output").inner_text()


def test_it_plays(page: Any) -> None:
    section = page.locator("section").first
    button = section.locator("button.play")
    button.focus()
    page.keyboard.press("Enter")
    assert button.inner_text() == "Pause"
    page.wait_for_function("Number(document.querySelector('input.time').value) > 3")
    page.keyboard.press("Enter")
    assert button.inner_text() == "Play"
