"""A log file to Scan records."""

from scanchain.logs.log import Log, open_log, sources_of

__all__ = ["Log", "open_log", "sources_of"]
