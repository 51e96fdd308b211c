"""The rerun recording: entities, batches, sinks and the viewer."""

import os

# errors of writing are our own warnings; the library's own lines on it would come in between, in color
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off")
