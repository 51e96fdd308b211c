"""Compiled kernels are kept by the source of all of them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import scanchain.kernels

WHERE = "import scanchain.kernels, numba; print(numba.config.CACHE_DIR)"


def cache_of(package, cache, **environment):
    variables = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    variables |= {"PYTHONPATH": str(package), "XDG_CACHE_HOME": str(cache), **environment}
    done = subprocess.run(
        [sys.executable, "-c", WHERE], env=variables, capture_output=True, text=True, cwd=package
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def package_at(folder):
    kernels = folder / "scanchain" / "kernels"
    shutil.copytree(Path(scanchain.kernels.__file__).parent, kernels, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "scanchain" / "__init__.py").touch()
    return kernels


def test_a_change_to_any_kernel_gives_all_of_them_a_new_folder(tmp_path):
    kernels, cache = package_at(tmp_path), tmp_path / "cache"
    before = cache_of(tmp_path, cache)
    assert before.startswith(str(cache / "scanchain" / "kernels")) and before == cache_of(tmp_path, cache)
    with (kernels / "registration" / "weights.py").open("a") as file:
        file.write("# changed\n")
    assert cache_of(tmp_path, cache) != before


def test_a_folder_that_the_user_chose_stays_and_one_that_cannot_be_made_is_no_error(tmp_path):
    package_at(tmp_path)
    chosen = str(tmp_path / "mine")
    assert cache_of(tmp_path, tmp_path / "cache", NUMBA_CACHE_DIR=chosen) == chosen
    (tmp_path / "file").touch()
    assert cache_of(tmp_path, tmp_path / "file") == ""
