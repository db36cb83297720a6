"""The documentation site, made of the texts beside the code and of docstrings; see CONTRIBUTING."""

from sphinx.ext.napoleon import NumpyDocstring
from sphinx.util.inspect import TypeAliasForwardRef

import simbias

project, author, version = "simbias", "The simbias developers", simbias.__version__
root_doc = "index"
exclude_patterns = [".*", "site", "trials", "mlartifacts", "simbias/templates", "**/table.md", "**/errors.md"]
exclude_patterns += ["README.md", "sweeps/results/figures/fig*.md", "**/paired.md", "**/node_modules"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
napoleon_google_docstring = False
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_type_aliases = {"Array": "Array", "Indices": "Indices"}  # short names of NumPy's arrays
autodoc_default_options = {"members": True}
html_theme = "furo"

# Napoleon takes what stands before a colon in an attribute's text for its type.
NumpyDocstring._parse_attribute_docstring = NumpyDocstring._consume_to_end
TypeAliasForwardRef.__repr__ = lambda alias: alias.name  # also in unions
