"""Maps that live on: localization in a map, merging of maps, and what changed between them."""
