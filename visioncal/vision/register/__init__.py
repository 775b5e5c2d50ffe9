"""A flat print found in an image by all its pixels."""
