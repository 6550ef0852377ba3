"""What the viewer shows and what its user has chosen, without Qt: views observe it."""
