"""Effects: vectors of unknowns that move many observations together, one file each."""
