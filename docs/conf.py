"""Settings of the documentation: Markdown pages, reference pages generated from the code."""  # noqa: INP001

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS.parent), str(DOCS / "_ext")]

project = "socast"
author = "the socast developers"
release = version = installed_version("socast")

extensions = ["sphinx.ext.autodoc", "numpydoc", "myst_nb", "generated_pages"]
source_suffix = {".md": "myst-nb"}
nb_execution_mode = "auto"
nb_execution_timeout = 300  # [s]
nb_execution_raise_on_error = True
nb_execution_show_tb = True
exclude_patterns = ["_ext", "_static"]

default_role = "code"  # single backticks in docstrings
smartquotes = False  # two dashes begin an option

html_theme = "pydata_sphinx_theme"
html_title = "socast"
html_sidebars = {page: [] for page in ("index", "missing-effect", "glossary", "changelog")}
html_static_path = ["_static"]
html_css_files = ["socast.css"]
html_show_sourcelink = False
html_show_copyright = False
html_theme_options = {
    "navigation_with_keys": False,
    "header_links_before_dropdown": 7,
    "show_toc_level": 2,
    "footer_start": [],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
myst_all_links_external = False

autodoc_typehints = "none"  # the docstrings give types, with shapes and units
autodoc_member_order = "bysource"
autodoc_default_options = {
    "no-value": True,
    "exclude-members": "set_fit_request, set_predict_request, set_score_request",  # methods that scikit-learn adds
}
autosummary_generate = False
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
