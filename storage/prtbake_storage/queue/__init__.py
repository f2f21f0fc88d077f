"""The job engine behind one small interface."""
