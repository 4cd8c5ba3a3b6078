"""Make a notebook of a tutorial without ROS: its blocks are run one after the other, their output is kept.

python docs/make_notebook.py docs/tutorials/csv.md
"""

import base64
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```\n", re.DOTALL | re.MULTILINE)
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}


def cells_of(page):
    """Return the cells of a page (text): what is Markdown in it, and each block as code, not yet run."""
    cells, done = [], 0
    for number, found in enumerate(BLOCK.finditer(page), start=1):
        before, source = page[done : found.start()].strip(), found[2].rstrip("\n")
        if before:
            cells.append({"cell_type": "markdown", "metadata": {}, "source": before})
        cells.append({
            "cell_type": "code", "execution_count": number, "metadata": {}, "outputs": [],
            "source": f"%%bash\n{source}" if found[1] == "bash" else source,
        })  # fmt: skip
        done = found.end()
    if rest := page[done:].strip():
        cells.append({"cell_type": "markdown", "metadata": {}, "source": rest})
    return [{**cell, "id": f"cell-{k}"} for k, cell in enumerate(cells)]


def run(cells, folder):
    """Run the code in a folder, each cell as a program of its own, and keep what it prints and draws."""
    tools = folder / "bin"
    tools.mkdir()
    (tools / "slpi").write_text(f'#!/bin/sh\nexec {sys.executable} -m slpi_ros.cli "$@"\n')
    (tools / "slpi").chmod(0o755)
    environment = os.environ | {"PATH": f"{tools}:{os.environ['PATH']}", "MPLBACKEND": "agg"}
    for cell in cells:
        if cell["cell_type"] != "code":
            continue
        shell, source = cell["source"].startswith("%%bash\n"), cell["source"].removeprefix("%%bash\n")
        command = ["bash", "-euc", source] if shell else [sys.executable, "-c", source]
        drawn = set(folder.glob("*.png"))
        ended = subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        if ended.stdout:
            cell["outputs"].append({"output_type": "stream", "name": "stdout", "text": ended.stdout})
        for picture in sorted(set(folder.glob("*.png")) - drawn):
            data = {"image/png": base64.b64encode(picture.read_bytes()).decode()}
            cell["outputs"].append({"output_type": "display_data", "data": data, "metadata": {}})


def main():
    page = Path(sys.argv[1])
    cells = cells_of(page.read_text())
    with tempfile.TemporaryDirectory() as folder:
        run(cells, Path(folder))
    notebook = {"cells": cells, "metadata": {"kernelspec": KERNEL}, "nbformat": 4, "nbformat_minor": 5}
    page.with_suffix(".ipynb").write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
