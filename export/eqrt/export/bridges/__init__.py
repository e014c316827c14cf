"""Recordings for other programs: Foxglove, PlotJuggler, ROS 2. None of it runs in the service."""
