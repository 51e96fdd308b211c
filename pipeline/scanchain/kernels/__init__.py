"""Everything compiled: arrays in, arrays out."""

import hashlib
import os
from pathlib import Path

from numba import config


def _cache_by_source() -> None:
    """Keep compiled kernels in a folder of the user's cache that is named after their source.

    Numba looks at the file of a kernel only, not at those of the kernels that it calls: after a change to one of
    them, by an editor or an upgrade, a cache beside the source would go on with what was compiled before. A folder
    that is chosen by NUMBA_CACHE_DIR stays; where no folder can be made, Numba looks for a place as it is used to.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = root / "scanchain" / "kernels" / digest.hexdigest()[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue]


_cache_by_source()
