"""Keypoints in pixels -> joints in metres."""
