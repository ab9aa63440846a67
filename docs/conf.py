"""The settings of the site (`make docs`). The build needs no network but the package index.

The pages are Markdown (MyST). Five small extensions in docs/extensions/ do what no package does:
docstrings in Markdown, formulas as MathML, a page for each public name, the pictures of the pages, and
tables of measured figures.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

# The examples are compiled once and run once: compile fast. With the flags of the tests, and with their
# cache, a second build needs a third of the time.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(HERE.parent / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
from importlib.metadata import version as version_of  # noqa: E402

if tuple(map(int, version_of("jaxlib").split(".")[:2])) < (0, 12):
    flags = ("--xla_backend_optimization_level=0", "--xla_cpu_use_fusion_emitters=false")
    os.environ.setdefault("XLA_FLAGS", " ".join(flags))

import jax  # noqa: E402

import dvax  # noqa: E402

jax.config.update("jax_enable_x64", True)

project = "dvax"
author = "The dvax maintainers"
release = version = dvax.__version__
language = "en"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx.ext.intersphinx",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "docs.extensions.mathml",
    "docs.extensions.gallery",
    "docs.extensions.docstrings",
    "docs.extensions.figures",
    "docs.extensions.measured",
    "docs.extensions.reference",
]
root_doc = "index"
# Names in single backticks in the text of the gallery are code, and link to the reference.
default_role = "code"
exclude_patterns = ["extensions", "generated/backreferences", "**.ipynb"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
nitpicky = True
highlight_language = "text"
pygments_style = "a11y-high-contrast-light"
templates_path = ["_templates"]

# MyST: `$` is a currency in these pages, so that formulas are {math} roles and blocks.
myst_enable_extensions = ["colon_fence", "deflist", "fieldlist", "attrs_inline", "attrs_block"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

# Docstrings name types and shapes of their arguments; signatures stay short.
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 90

# Links into other projects' documentation need their inventories from the network, so they are made
# only where the environment says so; without them those names are plain text.
intersphinx_mapping = {}
if os.environ.get("DVAX_DOCS_INTERSPHINX") == "1":
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "scipy": ("https://docs.scipy.org/doc/scipy", None),
        "jax": ("https://docs.jax.dev/en/latest", None),
        "xarray": ("https://docs.xarray.dev/en/stable", None),
    }

sphinx_gallery_conf = {
    "examples_dirs": ["../examples/gallery"],
    "gallery_dirs": ["gallery"],
    "backreferences_dir": "generated/backreferences",
    "doc_module": ("dvax",),
    "reference_url": {"dvax": None},
    "inspect_global_variables": False,
    "abort_on_example_error": True,
    "reset_modules": ("docs.extensions.gallery.reset",),
    "image_scrapers": ("docs.extensions.gallery.figures",),
    "within_subsection_order": "docs.extensions.gallery.Order",
    "capture_repr": (),
    "remove_config_comments": True,
    "min_reported_time": 0,
    "show_signature": False,
    "download_all_examples": False,
    "thumbnail_size": (480, 330),
    "first_notebook_cell": "%matplotlib inline\n# pip install 'dvax[app]'",
    "write_computation_times": False,
    # Two at a time: a program is compiled by one thread for the most part.
    "parallel": 2,
}

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_only_copy_prompt_lines = True
copybutton_exclude = ".linenos, .gp, .go"
copybutton_selector = ", ".join(
    f"div.highlight-{kind} pre" for kind in ("python", "Python", "pycon", "toml", "console")
)

html_theme = "pydata_sphinx_theme"
html_title = f"dvax {release}"
html_static_path = ["_static"]
html_css_files = ["dvax.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "dvax"},
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "navbar_end": ["theme-switcher"],
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "show_nav_level": 1,
    "collapse_navigation": True,
    "show_prev_next": True,
    "back_to_top_button": False,
    "search_bar_text": "Search these pages",
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
}
html_sidebars = {"index": [], "start": []}
copyright = "the dvax maintainers, Apache-2.0"
