"""The commands, one file each; heavy imports are deferred until a command runs, so that --help is fast."""
