"""CAN messages to detections and ego motion, as a profile says."""
