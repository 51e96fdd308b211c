"""Other people's methods behind the same two verbs as our own."""
