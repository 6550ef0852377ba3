"""IQ to tone phases."""
