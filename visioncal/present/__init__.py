"""A result for people: the HTML report, the rerun recording and its viewer."""
