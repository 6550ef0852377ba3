"""The widgets: each observes the session and holds nothing that must outlive it."""
