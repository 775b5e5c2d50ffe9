"""At the cell: drivers of devices, capture, and a simulated cell to record."""
