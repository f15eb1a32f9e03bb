"""What the site is made of besides the files in docs: the front page from README.md, reference
pages from the code, notebooks run anew, lists. Hooks of mkdocs."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import reference
from mkdocs.structure.files import File, Files
from notebooks import notebook_page

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_CODE = re.compile(r"(```.*?```)", re.DOTALL)
# What a file of the checkout is on the site.
_LIBRARY = "ros2_ws/src/netpos/netpos"
_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changes.md",
    "docs/decisions": "decisions/README.md",
    "ros2_ws/src/netpos_msgs/msg": "reference/messages.md",
    f"{_LIBRARY}/tracking/config.py": "reference/parameters.md",
    f"{_LIBRARY}/tracking/networks/config.py": "reference/parameters.md",
    f"{_LIBRARY}/inertial/pdr_config.py": "reference/parameters.md",
    f"{_LIBRARY}/cli/main.py": "reference/commands.md",
    f"{_LIBRARY}/__init__.py": "reference/api.md",
}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are no files."""
    pages = {
        "index.md": of_site((ROOT / "README.md").read_text(encoding="utf-8"), ROOT),
        "changes.md": of_site((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), ROOT),
        "reference/parameters.md": reference.parameters_page(),
        "reference/messages.md": reference.messages_page(),
        "reference/commands.md": reference.commands_page(),
        "reference/api.md": reference.api_page(),
    }
    for uri, content in pages.items():
        files.append(File.generated(config, uri, content=content))
    for file in [f for f in files if f.src_uri.endswith(".ipynb")]:
        files.remove(file)
        page, pictures = notebook_page(Path(str(file.abs_src_path)))
        page_uri = file.src_uri.removesuffix(".ipynb")
        files.append(File.generated(config, f"{page_uri}.md", content=page))
        for name, data in pictures.items():
            files.append(File.generated(config, f"{Path(page_uri).parent}/{name}", content=data))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to files of the checkout become links to their pages."""
    path = DOCS / page.file.src_uri
    return of_site(markdown, path.parent) if path.exists() else markdown


def of_site(text: str, folder: Path) -> str:
    """A document of ``folder`` with links that lead to pages of the site; of a link to a file that
    has no page the words are left."""
    page_folder = os.path.relpath(folder, DOCS) if folder.is_relative_to(DOCS) else "."

    def link(match: re.Match[str]) -> str:
        mark, words, target = match.groups()
        if re.match(r"[a-z]+:|#", target):
            return match.group(0)
        name, _, anchor = target.partition("#")
        page = page_of((folder / name).resolve())
        if page is None:
            return words
        link_target = os.path.relpath(page, page_folder) + ("#" + anchor if anchor else "")
        return f"{mark}[{words}]({link_target})"

    pieces = _CODE.split(text)
    pieces[::2] = [_LINK.sub(link, piece) for piece in pieces[::2]]
    return "".join(pieces)


def page_of(path: Path) -> str | None:
    """The page of a file of the checkout, by its place on the site."""
    name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
    known = _PAGES.get(name) or _PAGES.get(str(Path(name).parent))
    if known is not None and not name.startswith("docs/decisions/"):
        return known
    if not path.is_relative_to(DOCS):
        return None
    return path.relative_to(DOCS).as_posix().replace(".ipynb", ".md")
