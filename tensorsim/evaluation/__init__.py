"""How far the pipeline is from the truth: films of people whose motion is known, and the maps of both."""
