"""The MCAP format; ``scanchain.logs.mcap`` reads its files."""

from mcap.writer import MCAP0_MAGIC

from scanchain.logs.formats import Format
from scanchain.logs.mcap.index import index_file

FORMAT = Format(
    "mcap", "MCAP", lambda _, head: head.startswith(MCAP0_MAGIC), lambda path, number, _: index_file(path, number),
    (".mcap",), "parts",
)  # fmt: skip
