"""Device drivers behind two small protocols: an arm and a camera."""
