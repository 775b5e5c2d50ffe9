"""The camera side: targets, their print, camera models, and the corners found in images."""
