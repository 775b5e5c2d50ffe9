"""Dense corner fitting in blurred, moving and badly lit images, with torch and kornia."""
