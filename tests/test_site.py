"""The site of the documents: it builds without a warning, loads nothing from elsewhere, and fits
a phone."""

from __future__ import annotations

import functools
import http.server
import os
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import netpos
import pytest
from netpos import messages as values
from netpos.cli.examples import EXAMPLES
from netpos.common.parameters import described_fields

pytestmark = pytest.mark.timeout(900)
ROOT = Path(__file__).resolve().parents[1]
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
LOOKED_AT = (
    "index",
    "tutorials/newcomer",
    "notebooks/arrays_to_track",
    "reference/parameters",
    "reference/api",
    "topics",
    "troubleshooting",
    "results/fokin2020",
)
_LOADED = re.compile(
    r"<(?:script|img|iframe|link)\b[^>]*?\b(?:src|href)=\"?(?:https?:)?//[^\s\">]+"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as `make docs` builds it, in another folder."""
    folder = tmp_path_factory.mktemp("site")
    made = subprocess.run(
        ["mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    assert "WARNING" not in made.stdout + made.stderr
    return folder


def page(site: Path, name: str) -> str:
    return (site / f"{name}.html").read_text(encoding="utf-8")


def test_every_page_loads_from_the_site_alone(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 100
    found = {path.name: _LOADED.findall(path.read_text(encoding="utf-8")) for path in pages}
    assert {name: links for name, links in found.items() if links} == {}
    assert _LOADED.search('<script src="https://elsewhere.org/a.js">')


def test_the_reference_has_every_parameter_command_message_and_name(site: Path) -> None:
    parameters = page(site, "reference/parameters")
    config = netpos.TrackerConfig
    assert [
        n for n, _, _ in described_fields(config) if f"<code>{n}</code>" not in parameters
    ] == []
    commands = page(site, "reference/commands")
    assert [name for name in EXAMPLES if f"netpos {name}<" not in commands] == []
    messages = page(site, "reference/messages")
    files = (ROOT / "ros2_ws/src/netpos_msgs/msg").glob("*.msg")
    assert [path.stem for path in files if f'id="{path.stem.lower()}"' not in messages] == []
    api = page(site, "reference/api")
    headings = re.findall(r'<h3 id="[^"]+" class="doc doc-heading">\s*netpos\.(\w+)', api)
    assert headings == netpos.__all__
    ids = [f'id="netpos.messages.values.{name}"' for name in values.__all__]
    assert [text for text in ids if text not in api] == []


def test_meanings_and_choices_are_shown_as_they_are_written(site: Path) -> None:
    """The meaning of an argument is no type, and a bar in code has no backslash."""
    api = page(site, "reference/api")
    assert "name, as in its measurements" in re.sub(r"<[^>]+>", "", api)
    assert "<code>name, as" not in api
    commands = page(site, "reference/commands")
    assert "SECONDS|auto" in commands
    assert "\\|" not in commands


def test_every_decision_is_listed(site: Path) -> None:
    listed = page(site, "decisions/index")
    names = [path.stem for path in (ROOT / "docs/decisions").glob("0*.md")]
    assert [name for name in names if f"{name}.html" not in listed] == []


def test_a_notebook_shows_its_pictures(site: Path) -> None:
    for name in ("arrays_to_track", "sweep_to_plot"):
        (picture,) = re.findall(r'src="([^"]+\.png)"', page(site, f"notebooks/{name}"))
        assert (site / "notebooks" / picture).stat().st_size > 1000


@pytest.fixture
def served(site: Path) -> Iterator[str]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Nothing."""

    handler = functools.partial(Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("width", [380, 1400])
def test_pages_fit_phone_and_desk(served: str, width: int) -> None:
    """No page is wider than the window, none asks another host, search finds a parameter."""
    found = [path for path in map(shutil.which, BROWSERS) if path]
    if not found:
        pytest.skip("no chromium here")
    sync_api = pytest.importorskip("playwright.sync_api")
    asked: list[str] = []
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found[0], args=["--no-sandbox"])
        window = browser.new_page(viewport={"width": width, "height": 900})
        window.on("request", lambda request: asked.append(request.url))
        for name in LOOKED_AT:
            window.goto(f"{served}/{name}.html")
            assert window.evaluate("document.documentElement.scrollWidth") <= width, name
        window.goto(f"{served}/index.html?q=coast_after_s")
        window.wait_for_selector(".md-search-result__link")
        browser.close()
    assert [url for url in asked if not url.startswith((served, "data:", "blob:"))] == []
