"""Notebooks as pages: run anew, with their outputs."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import nbformat
from jupyter_client import AsyncKernelManager
from nbclient import NotebookClient
from nbconvert import MarkdownExporter


def executed(path: Path, folder: Path) -> nbformat.NotebookNode:
    """A notebook after all its cells ran in ``folder``.

    Raises ``nbclient.exceptions.CellExecutionError`` where a cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    # The kernel inherits it; another one, as of a machine without a screen, would draw nothing.
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    resources = {"metadata": {"path": str(folder)}}
    with tempfile.TemporaryDirectory() as sockets:  # no port is opened
        socket = f"{sockets}/kernel"
        kernel = AsyncKernelManager(kernel_name="python3", transport="ipc", ip=socket)
        NotebookClient(notebook, km=kernel, timeout=300, resources=resources).execute(
            cleanup_kc=True
        )
    return notebook


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """Markdown of an executed notebook and its pictures by file name."""
    with tempfile.TemporaryDirectory() as folder:
        notebook = executed(path, Path(folder))
    resources = {"unique_key": path.stem, "output_files_dir": path.stem}
    text, resources_of_page = MarkdownExporter().from_notebook_node(notebook, resources)
    pictures = {Path(name).name: data for name, data in resources_of_page["outputs"].items()}
    for name in resources_of_page["outputs"]:
        text = text.replace(f"]({name})", f"]({Path(name).name})")
    note = (
        f"!!! note\n    This page is the notebook `docs/notebooks/{path.name}`, run when the site"
        " was built.\n"
    )
    head, _, rest = text.partition("\n\n")
    return f"{head}\n\n{note}\n{rest}", pictures
