"""Predictions on CAN, as datagrams and as JSON lines."""
