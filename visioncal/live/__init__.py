"""At the cell: planning of stops, drivers of devices, capture, and rehearsal without a robot."""
