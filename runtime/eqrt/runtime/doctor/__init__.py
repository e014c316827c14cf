"""`eqrt doctor`: is this machine fit for the service, and if not, what to do."""
