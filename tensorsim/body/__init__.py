"""The body: its joints and bones, its proportions, and how it moves."""
