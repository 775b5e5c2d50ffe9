"""The one fit: what the sightings of a cell determine, how surely, and what they leave open."""
