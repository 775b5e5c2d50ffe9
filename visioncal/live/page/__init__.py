"""Recording on a page in a browser: live picture, next pose, and the verdict at the end."""
