"""Executes a notebook as a reader would, cell by cell: `notebook.py FILE FOLDER`; prints what its cells print.

Its working folder is FOLDER. A cell that raises, or takes longer than the limit, ends with an error.
"""

from __future__ import annotations

import os
import sys

import nbformat
from nbclient import NotebookClient
from traitlets.config import Config

#: Longest time that a cell may take.
LIMIT_S = 600

notebook = nbformat.read(sys.argv[1], as_version=4)
nbformat.validate(notebook)
# The kernel listens on files of this user, not on ports that every user of the machine reaches. Their names are relative to the working
# folder, which must be the kernel's, too.
os.chdir(sys.argv[2])
config = Config({"KernelManager": {"transport": "ipc"}})
folder = {"metadata": {"path": "."}}
NotebookClient(notebook, timeout=LIMIT_S, kernel_name="python3", resources=folder, config=config).execute()
for cell in notebook.cells:
    for output in cell.get("outputs", []):
        if output.output_type == "stream" and output.name == "stdout":
            print(output.text, end="")
