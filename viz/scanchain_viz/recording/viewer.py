"""rerun's viewer as a separate process, in a window or a browser; waiting for its start has a timeout."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from time import monotonic, sleep
from urllib.parse import quote

from scanchain.errors import InputError, ScanchainError

HOST = "127.0.0.1"
PORT, WEB_PORT = 9876, 9090  # as of rerun itself: of its viewer and of its web server
_START_S = 8.0  # longest time until a viewer that was started listens


def grpc_address() -> str:
    """Address at which a viewer on this machine accepts data."""
    return f"rerun+http://{HOST}:{PORT}/proxy"


def web_address() -> str:
    """The page of the web viewer."""
    return f"http://{HOST}:{WEB_PORT}/?url={quote(grpc_address(), safe='')}"


def is_listening(port: int) -> bool:
    """True if a port of this machine accepts connections."""
    try:
        with socket.create_connection((HOST, port), timeout=0.3):
            return True
    except OSError:
        return False


def has_display() -> bool:
    """True if a window can be opened."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def start_window() -> None:
    """Open the viewer's window; it outlives the run. A viewer that is already open is used."""
    if is_listening(PORT):
        return
    if not has_display():
        raise ScanchainError(
            "no viewer spawned: there is no display; use --rerun web, or open the recording later"
        )
    _launch((PORT,), "--expect-data-soon")


def start_web(*recordings: Path) -> subprocess.Popen[bytes]:
    """Serve the web viewer on this machine only: of .rrd files, or of what is sent to ``PORT``."""
    for taken in (PORT, WEB_PORT):
        if is_listening(taken):
            raise ScanchainError(
                f"no web viewer: port {taken} is taken; close the program that uses it (another viewer?)"
            )
    return _launch((PORT, WEB_PORT), "--serve-web", "--web-viewer-port", str(WEB_PORT), *map(str, recordings))


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a viewer that was started here, with the process that its launcher started; it has nothing to save."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait(timeout=5.0)


def _launch(ports: tuple[int, ...], *arguments: str) -> subprocess.Popen[bytes]:
    """Start rerun bound to localhost only (its default is every interface), and wait for these ports."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "rerun_cli", "--bind", HOST, "--port", str(PORT), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        _wait(process, ports)
    except BaseException:  # Ctrl-C as well: the process runs in its own session
        stop(process)
        raise
    return process


def _wait(process: subprocess.Popen[bytes], ports: tuple[int, ...]) -> None:
    """Return once the viewer accepts connections and stays up: without a display it exits after a moment."""
    deadline = monotonic() + _START_S
    listening_since = None
    while monotonic() < deadline:
        if process.poll() is not None:
            raise ScanchainError(
                f"no viewer: it exited immediately with code {process.returncode}; try `rerun` on its own"
            )
        if listening_since is None and all(is_listening(port) for port in ports):
            listening_since = monotonic()
        # one that cannot open a window ends before
        if listening_since is not None and monotonic() - listening_since > 0.5:
            return
        sleep(0.02)
    raise ScanchainError(f"no viewer: it did not respond within {_START_S:.0f} s; try `rerun` on its own")


def show(path: Path, announce: Callable[[str], None], *, in_browser: bool) -> None:
    """Open a .rrd file: a window that outlives this process, or a page served on this machine until Ctrl-C.

    announce : called with the page's address
    """
    if not in_browser:
        if not has_display():
            raise InputError(f"{path}: there is no display; use scanchain view --web, or open the file elsewhere")
        command = [sys.executable, "-P", "-m", "rerun_cli", "--bind", HOST, str(path), "--new"]
        subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
        return
    server = start_web(path)
    try:
        address = web_address()
        announce(address)
        if has_display():
            webbrowser.open(address)
        code = server.wait()
        raise ScanchainError(f"the web viewer of {path} ended with code {code}; try `rerun {path}` on its own")
    except KeyboardInterrupt:
        return
    finally:  # whatever ends this ends the server
        stop(server)
