"""What surrounds the service where it runs: log, metrics, reload, real time, service manager."""
