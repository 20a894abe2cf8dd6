"""The documentation site: ``make docs``. Nothing in it is loaded from a network."""

from __future__ import annotations

import base64
import json
import os
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]

import torch_ekm
from _extension.packages import pages

project = "torch_ekm"
author = "The torch_ekm developers"
copyright = author
version = release = torch_ekm.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
    "sphinxcontrib.bibtex",
    "myst_nb",
    "_extension",
]
bibtex_bibfiles = ["references.bib"]
exclude_patterns = ["_build", "_extension", "_static", "_templates"]
templates_path = ["_templates"]
nitpicky = True
suppress_warnings = ["toc.empty_glob"]  # a benchmark that has not been measured

html_theme = "furo"
html_title = f"torch_ekm {version}"
if "TORCH_EKM_VERSIONS" in os.environ:  # address of the page that links the sites of all versions
    link = f'<a href="{os.environ["TORCH_EKM_VERSIONS"]}">Other versions</a>'
    html_theme_options = {"announcement": f"torch_ekm {version}. {link}"}
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["torch_ekm.css"]
smartquotes_action = "qe"  # quotes and ellipses: two hyphens of an option stay
html_copy_source = False
add_module_names = False
python_maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 4
mathjax3_config = {"options": {"enableMenu": False}}  # whose speech would come from a network

# notebooks are pages, with the outputs that are stored in them; they lie outside of this folder
nb_execution_mode = "off"
nb_ipywidgets_js: dict[str, dict[str, str]] = {}
nb_merge_streams = True
NOTEBOOKS = HERE / "tutorials" / "notebooks"
shutil.rmtree(NOTEBOOKS, ignore_errors=True)
NOTEBOOKS.mkdir(parents=True)
for notebook in sorted((ROOT / "notebooks").glob("[0-9]*.ipynb")):
    shutil.copy2(notebook, NOTEBOOKS)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    outputs = [one.get("data", {}) for cell in cells for one in cell.get("outputs", ())]
    shown = (data["image/png"] for data in outputs if "image/png" in data)
    (NOTEBOOKS / f"{notebook.stem}.png").write_bytes(base64.b64decode(next(shown)))  # for the gallery

# one generated page for each public package
autosummary_generate = True
autosummary_context = {"pages": pages()}
shutil.rmtree(HERE / "reference" / "api" / "generated", ignore_errors=True)
autodoc_default_options = {"members": True, "member-order": "bysource", "no-value": True}
autodoc_inherit_docstrings = False
autodoc_type_aliases = {"Array": "Array"}
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
