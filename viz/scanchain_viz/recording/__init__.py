"""The rerun recording: entities, batches, sinks and the viewer."""

import os

# writing errors become warnings of the run; rerun's own colored log lines would only clutter the output
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off")
