"""Import of foreign recordings, export of results, and files of a result."""
