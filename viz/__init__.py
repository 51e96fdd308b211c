"""Shows what the pipeline did: rerun recording, plots."""
