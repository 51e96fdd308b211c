"""A recording in rerun's viewer, in a window or in a browser."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from pipeline.errors import InputError
from viz import viewer


def show(path: Path, *, in_browser: bool) -> None:
    """Open a .rrd file: a window that lives on by itself, or a page served on this machine until Ctrl-C."""
    if not in_browser and sys.platform == "linux" and not _has_display():
        raise InputError(f"{path}: there is no display; use scanchain view --web, or open the file elsewhere")
    command = [sys.executable, "-m", "rerun_cli", "--bind", viewer.HOST, str(path)]
    if not in_browser:
        subprocess.Popen([*command, "--new"], start_new_session=True, stderr=subprocess.DEVNULL)
        return
    try:
        subprocess.run([*command, "--web-viewer", "--web-viewer-port", str(viewer.WEB_PORT)], check=False)
    except KeyboardInterrupt:
        return


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
