"""A log file to Scan records."""
