"""The main job: from a log to a run directory."""
