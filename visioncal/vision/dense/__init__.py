"""Corners of blurred, moving and badly lit images, by all their pixels: torch and kornia."""
