"""Key points in pixels -> joints in metres."""
