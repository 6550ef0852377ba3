"""Synthetic recordings, from a time-domain sum of rays."""
