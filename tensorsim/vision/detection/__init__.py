"""Images -> boxes of people."""
