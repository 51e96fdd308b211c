"""The rerun recording: entities, batches, sinks and the viewer."""
