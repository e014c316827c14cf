"""For other programs: recordings, and a running service. None of it runs in the service."""
