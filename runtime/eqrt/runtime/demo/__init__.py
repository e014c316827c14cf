"""Recorded traffic through the real service, scored against what happened next."""
