"""Decoders of messages: scans, clouds and poses, in every supported encoding."""
