"""How `scripts/docs` builds the site: pages in Markdown, reference from docstrings, tutorials as a gallery."""

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

import rfpose


def figures(block, block_vars, gallery_conf):
    """Keep the figures that a block of a tutorial made; they are known to no `pyplot`."""
    taken = gallery_conf.setdefault("rfpose_taken", set())
    paths = []
    for found in block_vars["example_globals"].values():
        if isinstance(found, Figure) and id(found) not in taken:
            taken.add(id(found))
            gallery_conf.setdefault("rfpose_kept", []).append(found)  # or another would get its id
            paths.append(next(block_vars["image_path_iterator"]))
            found.savefig(paths[-1], dpi=110)
    return figure_rst(paths, gallery_conf["src_dir"])


project = "rfpose"
author = "the authors of rfpose"
version = release = rfpose.__version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.mathjax", "numpydoc", "myst_parser", "sphinx_gallery.gen_gallery"]
exclude_patterns = ["tutorials/*.rst", "build"]
suppress_warnings = ["config.cache"]  # the scraper is a function
nitpicky = False
default_role = "py:obj"
html_theme = "alabaster"
html_theme_options = {"page_width": "1100px", "sidebar_width": "240px", "description": "Where mirrors point, by radio"}
html_static_path = []
html_show_sourcelink = False

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 4
myst_url_schemes = ["http", "https"]

autodoc_typehints = "signature"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

sphinx_gallery_conf = {
    "examples_dirs": ["tutorials"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "image_scrapers": (figures,),
    "capture_repr": ("_repr_html_", "__repr__"),
    "within_subsection_order": "FileNameSortKey",
    "show_memory": False,
    "min_reported_time": 1e9,
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_signature": False,
}
