"""Pictures of results and tracking runs, and what a picture of a run shows."""
