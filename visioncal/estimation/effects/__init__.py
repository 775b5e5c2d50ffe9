"""Effects: vectors of unknowns that act on many observations together, one file each."""
