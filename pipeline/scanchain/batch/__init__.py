"""Many logs, each in a process of its own."""
