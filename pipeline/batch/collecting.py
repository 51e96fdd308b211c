"""Which logs: paths, patterns, and files that list them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from glob import glob
from pathlib import Path

from scanchain.errors import InputError
from scanchain.logs.files import matching
from scanchain.source import Source, source_of

_WILD = frozenset("*?[")


def collect(named: Sequence[Source], manifests: Sequence[Path]) -> tuple[Source, ...]:
    """Every log once, in the order named; patterns stand for what they match, by name.

    manifests : text files with a path, address or pattern a line, paths relative to the file; # begins a comment
    Raises InputError for a pattern that matches nothing and a manifest that cannot be read.
    """
    paths = list(_matched(named, "the command line"))
    for manifest in manifests:
        paths += _matched(_listed(manifest), str(manifest))
    if not paths:
        raise InputError("no log is named; name some, or a --manifest that does")
    first: dict[Source, Source] = {}
    for path in paths:
        first.setdefault(path.resolve(), path)
    return tuple(first.values())


def _listed(manifest: Path) -> list[Source]:
    try:
        lines = manifest.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise InputError(f"{manifest}: cannot be read ({reason}); --manifest takes a list of paths") from None
    words = [line.partition("#")[0].strip() for line in lines]
    sources = [source_of(word) for word in words if word]
    return [manifest.parent / source if isinstance(source, Path) else source for source in sources]


def _matched(named: Iterable[Source], where: str) -> Iterator[Source]:
    """Sources with patterns replaced; a path that exists is taken as it is, whatever its letters."""
    for source in named:
        if isinstance(source, Path):
            is_pattern = bool(_WILD & set(str(source))) and not source.exists()
            found = list(map(Path, sorted(glob(str(source), recursive=True)))) if is_pattern else [source]
        else:
            found = matching(source) if "*" in source.url else [source]  # ? and [ belong to addresses
        if not found:
            raise InputError(f"{source}: matches nothing; correct the pattern in {where}")
        yield from found
