"""Files in and out: recordings of other programs, exports, and the folder of a result."""
