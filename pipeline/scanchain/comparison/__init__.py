"""Several odometries on the very same decoded scans, each in a process of its own."""
