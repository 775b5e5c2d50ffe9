"""At the cell: planning of stops, drivers of devices, capture, and a simulated cell to record."""
