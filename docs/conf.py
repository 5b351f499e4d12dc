"""Sphinx: the pages of this folder as a site (``make docs``).

The command line and the template of a study are written into ``_generated`` by the commands
themselves before each build, the gallery by Sphinx-Gallery.
"""

import re
import subprocess
import sys
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert

from optical_palpation.cli import app
from optical_palpation.runtime import software_version
from optical_palpation.study import write_template

HERE = Path(__file__).parent
GENERATED = HERE / "_generated"

project = "Optical palpation"
author = copyright = "The Optical Palpation developers"
version = release = software_version()

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["gallery/*", "_generated/gallery/*.ipynb"]
suppress_warnings = ["config.cache"]  # the gallery's options hold a function

# Pages in Markdown, notebooks executed anew in each build
myst_enable_extensions = ["colon_fence", "dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_show_tb = True
nb_merge_streams = True

# Python, from the docstrings
autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say it, with units
autodoc_class_signature = "separated"
autodoc_default_options = {"exclude-members": "__init__, __new__, model_config, model_post_init"}
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "_generated/gallery",
    "filename_pattern": r"plot_",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "remove_config_comments": True,
    "show_memory": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,
    "download_all_examples": False,
    "copyfile_regex": r"$^",
}

# Formulas as MathML, which browsers show without a script from elsewhere; dashes stay dashes, as in
# the names of options
html_math_renderer = "mathml"
smartquotes_action = "qe"

copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True
copybutton_line_continuation_character = "\\"

html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_sidebars = {"tutorial": []}  # a section of its own, with nothing to list
html_theme_options = {
    "show_prev_next": True,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 6,
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
}


def _summary(line: re.Match[str]) -> str:
    """Return a line of the list of commands with the whole summary, which typer cuts off."""
    for command in app.registered_commands:
        if (about := command.callback) and about.__name__ == line[1]:
            summary = (about.__doc__ or "").partition("\n")[0]
            return f"* [`{line[1]}`](#{line[1]}): {summary}"
    return line[0]


def _inline_formula(translator, node) -> None:
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _formula(translator, node) -> None:
    translator.body.append(f'<div class="math">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def _generate(_sphinx) -> None:
    GENERATED.mkdir(exist_ok=True)
    title = "The command line"
    command = ["-m", "typer", "optical_palpation.cli", "utils", "docs", "--title", title]
    named = ["--name", "optical-palpation", "--output", str(GENERATED / "command-line.md")]
    subprocess.run([sys.executable, *command, *named], check=True, stdout=subprocess.DEVNULL)
    page = GENERATED / "command-line.md"
    text = re.sub(r"^\* `(\w+)`: .*$", _summary, page.read_text(), flags=re.M)
    # names that fit into the contents of the page
    page.write_text(re.sub(r"^## `optical-palpation (\w+)`$", r"## `\1`", text, flags=re.M))
    template = GENERATED / "study.toml"
    template.unlink(missing_ok=True)
    write_template(template)


def _skip(_sphinx, _what, _name, thing, skip, _options) -> bool | None:
    """Leave out fields of tuples, which the docstring of their class explains."""
    return True if (thing.__doc__ or "").startswith("Alias for field number") else None


def setup(sphinx) -> None:
    """Add the formulas; write what the software says about itself before anything is read."""
    sphinx.add_html_math_renderer("mathml", (_inline_formula, None), (_formula, None))
    sphinx.connect("builder-inited", _generate, priority=1)
    sphinx.connect("autodoc-skip-member", _skip)
