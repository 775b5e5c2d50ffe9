"""Recording a session: an arm and a camera, view by view onto the disk."""
