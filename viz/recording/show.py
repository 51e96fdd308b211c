"""A recording in rerun's viewer, in a window or in a browser."""

from __future__ import annotations

import subprocess
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path

from scanchain.errors import InputError
from scanchain.viz.recording import viewer


def show(path: Path, tell: Callable[[str], None], *, in_browser: bool) -> None:
    """Open a .rrd file: a window that lives on by itself, or a page served on this machine until Ctrl-C.

    tell : told the page's address
    """
    if in_browser:
        _serve(path, tell)
        return
    if not viewer.has_display():
        raise InputError(f"{path}: there is no display; use scanchain view --web, or open the file elsewhere")
    command = [sys.executable, "-P", "-m", "rerun_cli", "--bind", viewer.HOST, str(path), "--new"]
    subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)


def _serve(path: Path, tell: Callable[[str], None]) -> None:
    """Until KeyboardInterrupt; whatever ends this ends the server."""
    server = viewer.start_web(viewer.PORT, viewer.WEB_PORT, path)
    try:
        address = viewer.web_address(viewer.PORT, viewer.WEB_PORT)
        tell(address)
        if viewer.has_display():
            webbrowser.open(address)
        code = server.wait()
        raise viewer.ViewerError(f"the web viewer of {path} ended with code {code}; try `rerun {path}` on its own")
    except KeyboardInterrupt:
        return
    finally:
        viewer.stop(server)
