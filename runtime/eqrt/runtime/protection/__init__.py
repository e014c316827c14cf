"""Checksums and counters that show whether a message came as it was sent, and whether in order."""
