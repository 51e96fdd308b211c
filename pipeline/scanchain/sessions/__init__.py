"""Reusing maps: localization in a map, merging of maps, and changes between maps."""
