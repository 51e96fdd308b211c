"""Messages taken apart: scans, clouds, poses, in every encoding that is understood."""
