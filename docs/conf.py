"""Sphinx: MyST pages, executed notebooks, and references made from the code."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "lerobot_latentsafe"
author = "the lerobot_latentsafe maintainers"
copyright = "the lerobot_latentsafe maintainers; Apache-2.0"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton", "console_reference"]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
source_suffix = {".md": "myst-nb"}

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_timeout = 900
nb_execution_raise_on_error = True

default_role = "literal"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_class_signature = "mixed"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "latentsafe for LeRobot"
html_static_path = ["_static"]
html_css_files = ["options.css"]
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}
