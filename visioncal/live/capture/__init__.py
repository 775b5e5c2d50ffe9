"""Recording a session from a live cell, one flushed view after the other."""
