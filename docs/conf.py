"""Sphinx configuration; `make docs` builds the pages."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import ibi_rs
from sphinx.application import Sphinx
from sphinx.util import logging

sys.path.insert(0, str(Path(__file__).parent))
from variants import shown

project = "ibi_rs"
author = "the ibi_rs contributors"
release = version = ibi_rs.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"ibi_rs {release}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes and units, which the annotations do not
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_ivar = True


PRESETS = {
    "default": ibi_rs.Params(),
    "paper_synthetic": ibi_rs.Params.paper_synthetic(),
    "paper_real": ibi_rs.Params.paper_real(),
    "single_view": ibi_rs.Params.single_view(),
    "many_views": ibi_rs.Params.many_views(),
}


def _plain_values(params: ibi_rs.Params) -> dict[str, Any]:
    """Every parameter by its path, and each stage's word by the name of the stage."""
    values: dict[str, Any] = {}
    for name, value in params.to_dict().items():
        if isinstance(value, dict):
            values[name] = value["variant"]
            values |= {f"{name}.{key}": entry for key, entry in value.items() if key != "variant"}
        else:
            values[name] = value
    return values


def check_presets(app: Sphinx) -> None:
    """Warn, and so fail the build, where the preset table of parameters.md differs from the presets."""
    page = (Path(app.srcdir) / "parameters.md").read_text(encoding="utf-8")
    table = page.partition("| parameter | " + " | ".join(PRESETS) + " |\n")[2].partition("\n\n")[0]
    written: dict[str, list[str]] = {}
    for row in table.splitlines()[1:]:
        name, *cells = (cell.strip(" `") for cell in row.strip("|").split("|"))
        written[name] = cells
    values = [_plain_values(params) for params in PRESETS.values()]
    names = {name for preset in values for name in preset}
    real = {name: [shown(preset[name]) if name in preset else "–" for preset in values] for name in names}
    for name in sorted(names | written.keys()):
        if written.get(name) != real.get(name):
            text = "parameters.md, preset table: %s is %s in the package and %s on the page"
            logging.getLogger(__name__).warning(text, name, real.get(name), written.get(name))


def list_references(_app: Sphinx, _what: str, _name: str, _obj: Any, _options: Any, lines: list[str]) -> None:
    """Turn numbered footnotes into lists: on one page, those of several docstrings would have one name."""
    for i, line in enumerate(lines):
        lines[i] = re.sub(r"^( *)\.\. (\[\d+\]) ", r"\1-  \2 ", re.sub(r"(\[\d+\])_", r"\1", line))


def setup(app: Sphinx) -> None:
    """Register what is above."""
    app.connect("builder-inited", check_presets)
    app.connect("autodoc-process-docstring", list_references, priority=400)  # before napoleon
