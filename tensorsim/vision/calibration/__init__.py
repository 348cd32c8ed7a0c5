"""The camera of a film from the people who stand and walk in it."""
