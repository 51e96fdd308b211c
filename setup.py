"""Which folder is installed under which name; everything else stands in pyproject.toml."""

from setuptools import find_packages, setup

FOLDERS = {
    "scanchain": "pipeline",
    "scanchain_viz": "viz",
    "scanchain.presets": "configs",
    "scanchain.sequences": "sequences",
}

setup(
    package_dir=FOLDERS,
    packages=[
        *FOLDERS,
        *(f"scanchain.{name}" for name in find_packages("pipeline")),
        *(f"scanchain_viz.{name}" for name in find_packages("viz")),
    ],
)
