"""The tutorials run as they are written, each in a folder that looks like the checkout."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from documents import Page

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))


def in_checkout(tmp_path: Path) -> Path:
    """A folder with links to what is in the checkout; what a tutorial writes stays in it."""
    folder = tmp_path / "netpos"
    folder.mkdir()
    for name in ("scripts", "ros2_ws", "env.sh", "docs"):
        (folder / name).symlink_to(ROOT / name)
    return folder


def environment(domain_id: int) -> dict[str, str]:
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "COLUMNS": "100",
        "MPLBACKEND": "Agg",
    }


@pytest.mark.timeout(900)
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_runs(
    path: Path, tmp_path: Path, domain_id: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = in_checkout(tmp_path)
    monkeypatch.chdir(folder)
    page = Page(path, folder, environment(domain_id))
    page.run()
    assert page.ran >= 4
    assert page.compared >= 4


@pytest.mark.parametrize(
    ("block", "complaint"),
    [
        ("```bash\nfalse\ntrue\n```\n", "page.md:1"),
        ("```python\nprint(1)\n```\n\n```text\n2\n```\n", "page.md:5: not as shown: 1"),
        ("```python\nassert 1 == 2, 'odd'\n```\n", "odd"),
    ],
)
def test_a_page_that_is_wrong_fails(block: str, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(block, encoding="utf-8")
    with pytest.raises(AssertionError, match=complaint):
        Page(tmp_path / "page.md", tmp_path, os.environ).run()


def test_the_five_tutorials_are_there() -> None:
    names = {path.stem for path in TUTORIALS}
    assert {"newcomer", "first_run", "own_rsus", "own_recording", "tuning"} <= names
