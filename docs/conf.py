"""Sphinx's settings: `make docs` writes these pages to docs/_build/html.

The pages are Markdown that GitHub shows too. A link to a file outside of this folder becomes a download of that file.
"""

from typing import NoReturn

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import sb3_momba

project = "sb3-momba"
author = "the authors of sb3-momba"
version = release = sb3_momba.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
nitpicky = True
# Types of other projects: their pages would have to be downloaded to know that they exist.
nitpick_ignore_regex = [(r"py:.*", r"(?!sb3_momba|MOMBA|Momba|Pareto|Preference|Simba|Mlp).*")]
# Protocols of arguments, whose docstrings say what they ask for.
nitpick_ignore = [("py:class", f"sb3_momba.{name}") for name in ("nn.networks.Architecture", "pareto.evaluation.Predictor")]
default_role = "code"  # `single backticks` in docstrings

myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]  # GitHub's way to write an equation
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autoclass_content = "class"

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"sb3-momba {release}"
html_copy_source = False


def write_mathml(translator: HTML5Translator, node: nodes.math | nodes.math_block) -> NoReturn:
    """Equations as MathML, which browsers draw by themselves: the site asks nothing of a network."""
    translator.body.append(tex2mathml(node.astext(), as_block=isinstance(node, nodes.math_block)))
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    app.add_html_math_renderer("mathml", (write_mathml, None), (write_mathml, None))
