"""Detections to tracks in the map frame, the ego vehicle's motion taken out."""
