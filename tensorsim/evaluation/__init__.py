"""How far the pipeline is from the truth: films of people with known motion, and the maps of both."""
