"""Configuration of Sphinx: ``make docs``. Nothing is fetched from the network."""

import os
import sys
from importlib.metadata import version as installed
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # the extensions of our own lie here
os.environ["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))  # of the notebook

project = "scanchain"
version = release = installed("scanchain")
copyright = "the authors of scanchain"

extensions = ["myst_nb", "sphinx.ext.autodoc", "command_reference", "config_reference", "docstrings", "mathml"]
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
nb_execution_mode = "force"  # each time, so that no result is older than the program
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600  # s of a cell; the first ones compile kernels
nb_output_stderr = "remove"  # that kernels are compiled, once after an installation
nb_ipywidgets_js = {}  # of the network

autodoc_class_signature = "mixed"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autoclass_content = "both"
autodoc_type_aliases = {name: name for name in ("AnyPoints", "Logs", "Matrix", "Points", "Pose", "RawPoints")}
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100

html_theme = "furo"
html_math_renderer = "mathml"
html_title = f"scanchain {version}"
html_copy_source = False
font = Path(find_spec("ziamath").origin).parent / "fonts" / "STIXTwoMath-Regular.ttf"  # of equations; OFL
html_static_path = ["style.css", str(font)]
html_css_files = ["style.css"]
