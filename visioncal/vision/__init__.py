"""Targets, their printing, camera models, and detection of corners in images."""
