"""Range differences to receiver positions, and those to mirror normals."""
